"""What logs say before anything is simulated: regression of measured efforts on inverse dynamics, in seconds."""
