"""The site on an MQTT broker: retained states and alarms, discovery by Home Assistant, requests of operators."""
