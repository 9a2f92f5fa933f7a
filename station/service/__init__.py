"""The shell around the science: clocks, threads, signals, disks; knows no equation."""
