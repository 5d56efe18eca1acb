//! Whether an open file has some contents.

use std::{
    fs::File,
    io::{self, Read},
};

pub fn has_bytes(file: &File, bytes: &[u8]) -> io::Result<bool> {
    has_contents(file, bytes.len() as u64, bytes)
}

/// `length`: that of the contents.
pub fn has_contents(file: &File, length: u64, contents: impl Read) -> io::Result<bool> {
    Ok(file.metadata()?.len() == length && same_contents(contents, file)?)
}

/// Returns whether both readers give the same bytes.
fn same_contents(mut one: impl Read, mut other: impl Read) -> io::Result<bool> {
    let (mut a, mut b) = (vec![0; 1 << 16], vec![0; 1 << 16]);
    loop {
        let length = read_full(&mut one, &mut a)?;
        if length != read_full(&mut other, &mut b)? || a[..length] != b[..length] {
            return Ok(false);
        }
        if length == 0 {
            return Ok(true);
        }
    }
}

/// Fills `block`, or stops at the end of the input; returns the number of bytes read.
fn read_full(from: &mut impl Read, block: &mut [u8]) -> io::Result<usize> {
    let mut length = 0;
    while length < block.len() {
        match from.read(&mut block[length..])? {
            0 => break,
            n => length += n,
        }
    }
    Ok(length)
}
