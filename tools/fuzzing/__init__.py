"""Bad input for everything that reads a file: seeds, mutations, and what must hold whatever the input is."""
