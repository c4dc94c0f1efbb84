"""Import of posed photographs as a problem: cameras, masks, initial shape, texture atlas, undistorted references."""
