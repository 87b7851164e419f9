"""The program: rows in time, what is carried and read, their sweep, factorisation and matrices."""
