"""Which flight to fly next: the one that tells the likeliest causes apart."""
