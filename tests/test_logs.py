"""Log records as single logfmt lines."""

from __future__ import annotations

import logging

from station.logs import LineFormatter, logfmt


def record(message, level=logging.WARNING):
    log_record = logging.LogRecord("station", level, __file__, 1, message, None, None)
    log_record.created = 1_795_243_146.0
    return log_record


def test_values_are_quoted_if_necessary():
    assert logfmt(scan="a.laz", points=12) == "scan=a.laz points=12"
    assert logfmt(reason='cut "off"\nhere', empty="") == 'reason="cut \\"off\\"\\nhere" empty=""'


def test_record_is_one_line_with_time_and_level():
    line = LineFormatter(for_journald=False).format(record("scan=a.laz\r\nfaked=1"))
    assert line == "time=2026-11-21T06:39:06Z level=warning scan=a.laz\\nfaked=1"


def test_journald_format_has_priority_and_no_time():
    assert LineFormatter(for_journald=True).format(record("scan=a.laz")) == "<4>level=warning scan=a.laz"
