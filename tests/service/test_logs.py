"""A log line is one line that a machine can take apart."""

from __future__ import annotations

import logging

from station.service.logs import OneLine, logfmt


def record(message, level=logging.WARNING):
    made = logging.LogRecord("station", level, __file__, 1, message, None, None)
    made.created = 1_795_243_146.0
    return made


def test_values_are_quoted_where_they_need_it():
    assert logfmt(scan="a.laz", points=12) == "scan=a.laz points=12"
    assert logfmt(reason='cut "off"\nhere', empty="") == 'reason="cut \\"off\\"\\nhere" empty=""'


def test_a_record_is_one_line_with_time_and_level():
    line = OneLine(for_journald=False).format(record("scan=a.laz\r\nfaked=1"))
    assert line == "time=2026-11-21T06:39:06Z level=warning scan=a.laz\\nfaked=1"


def test_journald_gets_the_priority_and_keeps_the_time():
    assert OneLine(for_journald=True).format(record("scan=a.laz")) == "<4>level=warning scan=a.laz"
