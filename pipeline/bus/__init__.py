"""The bus: the only room that knows Zenoh."""
