"""The OPC UA server of a site: fans as objects, alarms as conditions of Part 9."""
