"""What remains of a run: the bag, the figures, the replay, the video and the page that shows them."""
