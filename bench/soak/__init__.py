"""kill -9 again and again under load: what was acknowledged must be there afterwards, and every file whole."""
