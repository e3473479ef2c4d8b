"""What the learned methods share: their weight files, how these are fetched and read, and the device."""
