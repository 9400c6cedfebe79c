"""What several runs say together: a page of curves, tables, films and settings that opens without a server."""
