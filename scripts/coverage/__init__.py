"""Every plugin of the Mitsuba wheel in a small scene: which parameters work, and what is refused."""
