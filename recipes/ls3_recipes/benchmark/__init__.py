"""How long everything takes here, beside the same networks with nothing done for speed."""
