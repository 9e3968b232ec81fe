"""The simulated air-hockey table: puck, mallet on its passive joint, and the iiwa that holds it."""
