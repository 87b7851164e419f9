"""What a run leaves behind: its record, pictures, films and pages."""
