"""Places recognised again, loops closed, and tracking after a loss."""
