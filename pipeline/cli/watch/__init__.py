"""Commands that run and watch a site."""
