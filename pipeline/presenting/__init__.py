"""What operators see and ask, whatever the way: a page, a message, a client of OPC UA or MQTT."""
