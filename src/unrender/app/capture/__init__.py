"""From a folder of posed photographs to a problem: cameras, masks, a first shape, an atlas, references without distortion."""
