"""What a reconstruction will take, and what will probably go wrong in it, before it begins."""
