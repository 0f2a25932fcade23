"""A team of robots: its session, its meetings, and what its members exchange."""
