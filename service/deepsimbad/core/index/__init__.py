"""The inverted index: landmark lists as they are kept, and what they answer."""
