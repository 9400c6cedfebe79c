"""Many runs as one: which, in what order, where they are carried out, and what came of them."""
