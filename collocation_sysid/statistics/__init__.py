"""What the data say of the parameters: error bars, identifiability, residuals."""
