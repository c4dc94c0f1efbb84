"""Arrays, parameter trees, seeds, argument checks, errors and the registry of components. Imports no other package of `unrender`."""
