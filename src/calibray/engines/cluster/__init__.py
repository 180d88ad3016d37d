"""Links in blocks, and the processes and machines that work on them."""
