"""The choice of the next flight: the one that tells the likeliest causes apart."""
