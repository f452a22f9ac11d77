"""Messages about alarms to people elsewhere: mail, chat, webhooks, Alertmanager."""
