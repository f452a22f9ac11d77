"""What shows and sends the state of a site: a folder for each way."""
