"""Training of the network that reads face UV maps; nothing outside this folder imports it."""
