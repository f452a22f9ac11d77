"""Which fault explains an alarm, with probabilities."""
