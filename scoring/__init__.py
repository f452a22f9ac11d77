"""From residuals to statistics, limits, alarm states and causes. Pure; docs/explanation/deciding.md explains it."""
