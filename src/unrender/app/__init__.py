"""The application around the library: command line, pages, captures, exports, sweeps, distributed runs."""
