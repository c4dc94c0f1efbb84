"""How far a picture is from its reference, and pictures without their noise."""
