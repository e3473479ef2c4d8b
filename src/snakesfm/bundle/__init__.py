"""Bundle adjustment, and what is done to the model between its rounds."""
