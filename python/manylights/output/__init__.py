"""What is written for people and read again: images, and the names of their channels."""
