//! Parses arguments, prints errors, sets the exit code; nothing else.

fn main() {}
