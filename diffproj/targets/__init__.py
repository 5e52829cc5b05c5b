"""What is known in the world, and where photographs show it: boards, views of them, and how they are found or drawn."""
