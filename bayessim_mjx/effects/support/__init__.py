"""What effects share: where they sit, how they are read and kept, how they become native elements."""
