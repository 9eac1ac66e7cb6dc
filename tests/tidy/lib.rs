//! Nothing of its own: a package so that these tests compile without the program.
