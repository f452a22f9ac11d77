"""One command of `fantwin` a module."""
