"""Numbers, charts and pictures for people, wherever they are shown: on a terminal, on a page, in a notebook."""
