"""What people look at: the Rerun view, pictures and plots."""
