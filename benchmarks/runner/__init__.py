"""Arguments, records, timing in turns, the machine's load, and the results page, alike for every benchmark."""
