"""How long everything takes here, compared with the same networks with nothing done for speed."""
