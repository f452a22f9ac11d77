"""The web server of a site: operators' page, API, live events and metrics."""
