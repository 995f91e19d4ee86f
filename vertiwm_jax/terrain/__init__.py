"""The ground: heights, classes, soils, and how to ask a map about them."""
