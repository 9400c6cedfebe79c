"""Pictures: of any run, of an LS³ agent, of several runs, and of the domains."""
