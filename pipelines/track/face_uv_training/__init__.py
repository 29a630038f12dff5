"""Train the network that reads face UV maps; nothing outside imports it."""
