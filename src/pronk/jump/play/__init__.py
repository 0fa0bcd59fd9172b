"""The virtual robot in real time, in a web page: `pronk play`."""
