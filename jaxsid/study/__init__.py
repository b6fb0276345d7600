"""Monte-Carlo studies of how noise, sensors and settings spread what is identified."""
