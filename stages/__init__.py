"""One independent stage a module; none imports another."""
