"""What is done with a problem: check, solve, simulate forward, refine, and what was found."""
