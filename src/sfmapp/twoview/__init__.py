"""Two photographs, told step by step: why they give a reconstruction, or why not."""
