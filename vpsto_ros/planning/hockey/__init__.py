"""Air hockey (chapter 5): contact planning, strikes of the arm, and an agent that plays."""
