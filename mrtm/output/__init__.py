"""What a run leaves behind: files, pictures, and lines on the screen."""
