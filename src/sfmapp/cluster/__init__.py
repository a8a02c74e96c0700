"""Units of work on other processes and other machines."""
