"""The equations of motion: inputs from parameters, forces from inputs, and how time is stepped."""
