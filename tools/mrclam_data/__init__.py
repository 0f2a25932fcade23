"""The UTIAS MRCLAM data sets: reading them, their odometry, and the joint graph of robots that only see each other."""
