"""The virtual robot behind LCM and DDS, with faults."""
