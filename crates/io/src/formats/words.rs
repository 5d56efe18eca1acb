//! Tokenizer for text files whose fields are separated by white space, including line ends.

use std::{cell::Cell, str::FromStr};

use nom::{
    IResult, Parser,
    bytes::complete::{take_till, take_till1},
    character::complete::multispace0,
    combinator::map_res,
    sequence::preceded,
};

use viewrank_core::base::large_pages;

use super::{Fault, Place, Problem, start_of};

/// The unread part of a text file.
#[derive(Clone)]
pub(super) struct Words<'a> {
    whole: &'a [u8],
    rest: &'a [u8],
    /// An offset and its line number, from which to continue counting lines.
    counted: Cell<(usize, u64)>,
}

impl<'a> Words<'a> {
    pub fn new(whole: &'a [u8]) -> Self {
        Self {
            whole,
            rest: whole,
            counted: Cell::new((0, 1)),
        }
    }

    /// Parses the next field.
    pub fn number<T: FromStr>(&mut self, expected: &'static str) -> Result<T, Fault> {
        match number(self.rest) {
            Ok((rest, value)) => {
                self.rest = rest;
                Ok(value)
            }
            Err(_) => Err(self.unexpected(expected)),
        }
    }

    pub fn numbers<const N: usize>(&mut self, expected: &'static str) -> Result<[f64; N], Fault> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(expected)?;
        }
        Ok(values)
    }

    /// Returns the rest of the line, trimmed; `None` at the end of the file.
    pub fn line(&mut self) -> Option<&'a [u8]> {
        if self.rest.is_empty() {
            return None;
        }
        let line: IResult<_, _> = take_till(|b| b == b'\n').parse(self.rest);
        let (left, line): (&[u8], &[u8]) = line.unwrap_or((&[], self.rest));
        self.rest = left.get(1..).unwrap_or(&[]);
        Some(line.trim_ascii())
    }

    /// Returns the next line that is not blank.
    pub fn full_line(&mut self) -> Option<&'a [u8]> {
        std::iter::from_fn(|| self.line()).find(|line| !line.is_empty())
    }

    /// Parses a number of records, at least `smallest` bytes each; refuses one too large for the
    /// rest of the file.
    pub fn count(&mut self, what: &'static str, smallest: usize) -> Result<usize, Fault> {
        let at = self.place();
        let count: u64 = self.number(what)?;
        // The last field of a file needs no separator after it.
        let room = (self.rest.len() + 1) / smallest;
        let fits = usize::try_from(count).ok().filter(|&n| n <= room);
        fits.ok_or(
            Problem::Count {
                what,
                count,
                room: room as u64,
            }
            .at(at),
        )
    }

    /// Parses records; a fault names the number of its record.
    pub fn records<T>(
        &mut self,
        what: &'static str,
        count: usize,
        mut record: impl FnMut(&mut Self) -> Result<T, Fault>,
    ) -> Result<Vec<T>, Fault> {
        let mut records = large_pages::room_for(count);
        for n in 1..=count {
            let read = record(self).map_err(|fault| fault.in_record(|| format!("{what} {n}")));
            records.push(read?);
        }
        Ok(records)
    }

    pub fn at_end(&self) -> bool {
        self.rest.trim_ascii().is_empty()
    }

    /// Line of the next field.
    pub fn place(&self) -> Place {
        let (from, line) = self.counted.get();
        let to = self.whole.len() - self.rest.trim_ascii_start().len();
        let between = self.whole.get(from..to).unwrap_or_default();
        let line = line + between.iter().filter(|&&b| b == b'\n').count() as u64;
        self.counted.set((to, line));
        Place::Line(line)
    }

    pub fn fault(&self, problem: Problem) -> Fault {
        problem.at(self.place())
    }

    pub fn unexpected(&self, expected: &'static str) -> Fault {
        let found = match token(self.rest) {
            Ok((_, token)) => start_of(token),
            Err(_) => "the end of the file".into(),
        };
        self.fault(Problem::Syntax { expected, found })
    }
}

fn token(input: &[u8]) -> IResult<&[u8], &[u8]> {
    preceded(multispace0, take_till1(|b: u8| b.is_ascii_whitespace())).parse(input)
}

fn number<T: FromStr>(input: &[u8]) -> IResult<&[u8], T> {
    map_res(token, parse).parse(input)
}

/// Parses a field as a number.
pub(super) fn parse<T: FromStr>(field: &[u8]) -> Result<T, ()> {
    std::str::from_utf8(field)
        .map_err(drop)
        .and_then(|text| text.parse().map_err(drop))
}

/// Splits a line into a name, which may contain white space, and the `N` numbers after it.
pub(super) fn name_and_numbers<const N: usize>(line: &[u8]) -> Option<(&[u8], [f64; N])> {
    let mut numbers = [0.0; N];
    let mut left = line.trim_ascii();
    // From the end: the name may have blanks, and words that are numbers.
    for number in numbers.iter_mut().rev() {
        let start = left.iter().rposition(|b| b.is_ascii_whitespace())?;
        *number = parse(&left[start + 1..]).ok()?;
        left = left[..start].trim_ascii_end();
    }
    Some((left, numbers))
}
