//! NumPy's `.npy`, versions 1 to 3: the signature `\x93NUMPY`, two bytes of version, the length of
//! the header (u16, from version 2 on u32, little-endian), the header, and the values (NumPy
//! Enhancement Proposal 1). The header is a Python dictionary with `descr`, `fortran_order` and
//! `shape`.
//!
//! Reads and writes arrays of one plain type in C order.

use std::ops::Range;

use nom::{
    IResult, Parser,
    branch::alt,
    bytes::complete::{is_not, tag},
    character::complete::{char, multispace0, u64 as integer},
    combinator::{all_consuming, cut, opt, value},
    multi::{separated_list0, separated_list1},
    sequence::{delimited, preceded, terminated},
};

/// The fault of a header that is none, with an example.
const EXPECTED: &str =
    "expected a header such as {'descr': '<f4', 'fortran_order': False, 'shape': (300, 400), }";
const SIGNATURE: &[u8] = b"\x93NUMPY";
/// Bytes of signature and version.
const PREAMBLE: usize = 8;
/// Largest header that is read, bytes; that of a two-dimensional array has about 120.
const LONGEST_HEADER: usize = 512;
/// Values begin at a multiple of this, bytes.
const ALIGNMENT: usize = 64;

/// The byte offset of a fault, and what it is.
pub type Fault = (usize, String);

/// A file whose header was read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Array<'a> {
    /// Lengths of the dimensions; the last one varies fastest.
    pub shape: Vec<u64>,
    /// Kind and size of the values without the order of their bytes, such as `f4`.
    pub dtype: &'a str,
    big_endian: bool,
    /// Offset of the values.
    start: usize,
    /// The file from there on.
    data: &'a [u8],
}

/// A type of values.
pub trait Value: Sized {
    /// Its [`Array::dtype`].
    const DTYPE: &'static str;

    fn read(bytes: &[u8], big_endian: bool) -> Self;

    /// Appends the value, little-endian.
    fn append_to(self, bytes: &mut Vec<u8>);
}

macro_rules! values {
    ($($type:ty, $dtype:literal;)*) => {$(
        impl Value for $type {
            const DTYPE: &'static str = $dtype;

            fn read(bytes: &[u8], big_endian: bool) -> Self {
                let mut own = [0; size_of::<Self>()];
                own.copy_from_slice(bytes);
                if big_endian {
                    own.reverse();
                }
                Self::from_le_bytes(own)
            }

            fn append_to(self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        }
    )*};
}
values! {
    f32, "f4";
    f64, "f8";
    u8, "u1";
    u32, "u4";
    u64, "u8";
}

/// Reads the header of a file.
///
/// # Errors
/// If the file isn't one of NumPy, its array is in Fortran order, or its values aren't of one plain
/// type.
pub fn read(file: &[u8]) -> Result<Array<'_>, Fault> {
    let at = header_range(file)?;
    let fault = |byte: usize, what: &str| (byte, what.to_string());
    let header = std::str::from_utf8(&file[at.clone()])
        .map_err(|error| fault(at.start + error.valid_up_to(), "the header isn't text"))?;
    let header = dictionary(header).map_err(|byte| fault(at.start + byte, EXPECTED))?;
    if header.fortran_order {
        let what = "Fortran order; convert it with np.ascontiguousarray before saving";
        return Err(fault(at.start, what));
    }
    let dtype = header.descr.strip_prefix(['<', '>', '|']);
    let dtype = dtype.filter(|dtype| is_type(dtype));
    // Other words may be those of a file that a stranger's link leads to.
    let unknown = || match header.descr {
        descr if is_type(descr) => fault(at.start, &format!("unknown type `{descr}`")),
        _ => fault(at.start, "its type is none of NumPy's plain ones"),
    };
    Ok(Array {
        shape: header.shape,
        dtype: dtype.ok_or_else(unknown)?,
        big_endian: header.descr.starts_with('>'),
        start: at.end,
        data: &file[at.end..],
    })
}

impl Array<'_> {
    /// Copies the values, the last dimension fastest. Bytes behind them don't count.
    ///
    /// # Errors
    /// If the values are of another type, or the file has fewer than its shape says. No memory is
    /// taken before.
    pub fn values<T: Value>(&self) -> Result<Vec<T>, Fault> {
        if self.dtype != T::DTYPE {
            let what = format!("values of type {}, expected {}", self.dtype, T::DTYPE);
            return Err((PREAMBLE, what));
        }
        let size = size_of::<T>();
        // A forged shape may have more values than can be counted.
        let needed = self
            .shape
            .iter()
            .try_fold(size, |all, &n| all.checked_mul(usize::try_from(n).ok()?));
        let data = needed.and_then(|needed| self.data.get(..needed));
        let data = data.ok_or_else(|| {
            let left = self.data.len();
            let what = format!("shape {:?} does not fit in {left} bytes", self.shape);
            (self.start + left, what)
        })?;
        let values = data.chunks_exact(size);
        Ok(values.map(|v| T::read(v, self.big_endian)).collect())
    }
}

/// Returns whether the text is a type without its byte order, such as `f4`.
fn is_type(text: &str) -> bool {
    let mut letters = text.chars();
    letters
        .next()
        .is_some_and(|kind| kind.is_ascii_alphabetic())
        && letters.all(|digit| digit.is_ascii_digit())
}

/// Where the header is in the file.
fn header_range(file: &[u8]) -> Result<Range<usize>, Fault> {
    let version = file
        .strip_prefix(SIGNATURE)
        .and_then(|rest| rest.first())
        .ok_or_else(|| (0, "not a NumPy file".to_string()))?;
    let start = match version {
        1 => PREAMBLE + 2,
        2 | 3 => PREAMBLE + 4,
        _ => {
            let what = format!("version {version}, expected 1, 2 or 3");
            return Err((SIGNATURE.len(), what));
        }
    };
    let cut_off = || (file.len(), "the header is cut off".to_string());
    let length = file.get(PREAMBLE..start).ok_or_else(cut_off)?;
    let length = length
        .iter()
        .rfold(0, |all, &byte| all << 8 | usize::from(byte));
    if length > LONGEST_HEADER {
        let what = format!("the header is longer than {LONGEST_HEADER} bytes");
        return Err((PREAMBLE, what));
    }
    let end = start + length;
    (end <= file.len())
        .then_some(start..end)
        .ok_or_else(cut_off)
}

struct Header<'a> {
    descr: &'a str,
    fortran_order: bool,
    shape: Vec<u64>,
}

#[derive(Clone)]
enum Entry<'a> {
    Descr(&'a str),
    FortranOrder(bool),
    Shape(Vec<u64>),
}

/// Reads the dictionary of a header; an error is the offset at which it isn't one. As in Python,
/// the last value of a key counts.
fn dictionary(text: &str) -> Result<Header<'_>, usize> {
    let entries = separated_list1(symbol(','), entry);
    let entries = delimited(symbol('{'), entries, (opt(symbol(',')), symbol('}')));
    let (_, entries) = all_consuming(entries)
        .parse(text)
        .map_err(|error| match error {
            nom::Err::Error(error) | nom::Err::Failure(error) => text.len() - error.input.len(),
            nom::Err::Incomplete(_) => text.len(),
        })?;
    Header::of_entries(entries).ok_or(0)
}

impl<'a> Header<'a> {
    fn of_entries(entries: Vec<Entry<'a>>) -> Option<Self> {
        let (mut descr, mut fortran_order, mut shape) = (None, None, None);
        for entry in entries {
            match entry {
                Entry::Descr(found) => descr = Some(found),
                Entry::FortranOrder(found) => fortran_order = Some(found),
                Entry::Shape(found) => shape = Some(found),
            }
        }
        Some(Self {
            descr: descr?,
            fortran_order: fortran_order?,
            shape: shape?,
        })
    }
}

fn entry(text: &str) -> IResult<&str, Entry<'_>> {
    // With `cut`, a fault of a value is placed at the value and not at its name.
    let flag = alt((value(true, tag("True")), value(false, tag("False"))));
    let lengths = terminated(separated_list0(symbol(','), integer), opt(symbol(',')));
    let shape = delimited(symbol('('), lengths, symbol(')'));
    alt((
        preceded(key("descr"), cut(string)).map(Entry::Descr),
        preceded(key("fortran_order"), cut(flag)).map(Entry::FortranOrder),
        preceded(key("shape"), cut(shape)).map(Entry::Shape),
    ))
    .parse(text)
}

/// A name and the colon behind it.
fn key<'a>(
    name: &'static str,
) -> impl Parser<&'a str, Output = (), Error = nom::error::Error<&'a str>> {
    let is_name = nom::combinator::verify(string, move |found: &str| found == name);
    value((), (is_name, symbol(':')))
}

fn string(text: &str) -> IResult<&str, &str> {
    alt((
        delimited(char('\''), is_not("'"), char('\'')),
        delimited(char('"'), is_not("\""), char('"')),
    ))
    .parse(text)
}

/// A character and the blanks around it.
fn symbol<'a>(
    symbol: char,
) -> impl Parser<&'a str, Output = char, Error = nom::error::Error<&'a str>> {
    delimited(multispace0, char(symbol), multispace0)
}

/// Returns the bytes of a file, little-endian.
///
/// # Panics
/// If there are not as many values as the shape says.
pub fn write<T: Value>(shape: &[usize], values: impl IntoIterator<Item = T>) -> Vec<u8> {
    let mut bytes = beginning::<T>(shape);
    let before = bytes.len();
    for value in values {
        value.append_to(&mut bytes);
    }
    let expected = size_of::<T>() * shape.iter().product::<usize>();
    assert_eq!(bytes.len() - before, expected, "values of an array");
    bytes
}

/// Signature, version and header.
fn beginning<T: Value>(shape: &[usize]) -> Vec<u8> {
    let lengths: String = shape.iter().map(|n| format!("{n}, ")).collect();
    // Single bytes have no order.
    let order = if size_of::<T>() == 1 { '|' } else { '<' };
    let dtype = T::DTYPE;
    let header =
        format!("{{'descr': '{order}{dtype}', 'fortran_order': False, 'shape': ({lengths}), }}");
    let start = PREAMBLE + 2;
    // A line break ends the header; blanks before it align the values.
    let padded = (start + header.len() + 1).next_multiple_of(ALIGNMENT) - start - 1;
    let header = format!("{header:padded$}\n");
    let length = u16::try_from(header.len()).expect("a header of a few dimensions");
    [SIGNATURE, &[1, 0], &length.to_le_bytes(), header.as_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;

    /// A file of version 1 with any header, and the bytes of two f32.
    fn with_header(header: &str) -> Vec<u8> {
        let length = u16::try_from(header.len()).unwrap().to_le_bytes();
        let values = [1.0f32, 2.0].map(f32::to_le_bytes);
        [
            b"\x93NUMPY\x01\0",
            &length[..],
            header.as_bytes(),
            values.as_flattened(),
        ]
        .concat()
    }

    fn fault_of(file: &[u8]) -> Fault {
        let values = |array: Array| array.values::<f32>();
        read(file).and_then(values).unwrap_err()
    }

    proptest! {
        #[test]
        fn arrays_are_read_as_written(shape in vec(0usize..4, 0..5), big_endian: bool, behind in 0usize..9) {
            let count = shape.iter().product();
            let values: Vec<f64> = (0..count).map(|i| 0.1 * i as f64 - 3.0).collect();
            let mut bytes = write(&shape, values.iter().copied());
            let start = bytes.len() - 8 * count;
            prop_assert_eq!(start % 64, 0);
            if big_endian {
                let (header, data) = bytes.split_at_mut(start);
                header[21] = b'>';
                data.chunks_exact_mut(8).for_each(<[u8]>::reverse);
            }
            bytes.extend(vec![0; behind]);
            let array = read(&bytes).unwrap();
            prop_assert!(array.shape.iter().copied().eq(shape.iter().map(|&n| n as u64)));
            prop_assert_eq!(array.values::<f64>().unwrap(), values);
            prop_assert!(array.values::<u64>().is_err());
        }

        #[test]
        fn changed_files_are_arrays_or_faults(at in 0usize..200, byte: u8, keep in 0usize..200) {
            let mut bytes = write(&[2, 3], [1u32, 2, 3, 4, 5, 6]);
            let at = at % bytes.len();
            bytes[at] = byte;
            bytes.truncate(keep);
            if let Ok(array) = read(&bytes) {
                let largest = bytes.len() / 4;
                prop_assert!(array.values::<u32>().map_or(0, |values| values.len()) <= largest);
            }
        }
    }

    #[test]
    fn headers_are_read_as_python_does() {
        for header in [
            "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }",
            "{'shape':(1,2),'fortran_order':False,'descr':'<f4'}",
            "  { \"shape\" : ( 2 , 1 , ) ,\n \"descr\" : \"<f4\" , 'fortran_order' : False }   \n",
            "{'descr': '<u8', 'descr': '<f4', 'fortran_order': False, 'shape': (2,)}",
        ] {
            let file = with_header(header);
            let array = read(&file).unwrap_or_else(|fault| panic!("{header}: {fault:?}"));
            assert_eq!(array.values::<f32>().unwrap(), [1.0, 2.0], "{header}");
        }
        // Version 2 has a length of four bytes; no dimension, one value.
        let mut file = with_header("{'descr': '<f4', 'fortran_order': False, 'shape': ()}");
        file[6] = 2;
        file.splice(10..10, [0, 0]);
        assert_eq!(read(&file).unwrap().values::<f32>().unwrap(), [1.0]);
    }

    #[test]
    fn faults_name_their_byte() {
        // What is there instead of `(2,)`, and where the fault is.
        let shape = |shape: &str| {
            with_header(&format!(
                "{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}"
            ))
        };
        let start = PREAMBLE + 2 + "{'descr': '<f4', 'fortran_order': False, 'shape': ".len();
        for (found, byte) in [
            ("[2]", 0),
            ("(-2,)", 1),
            ("(2", 2),
            ("(18446744073709551616,)", 1),
            ("(2,,)", 3),
        ] {
            assert_eq!(fault_of(&shape(found)).0, start + byte, "{found}");
        }
        let values = "{'descr': '<f4', 'fortran_order': False, 'shape': (2,)}".len() + 10;
        for too_many in [
            "(3,)",
            "(4294967296, 4294967296)",
            "(18446744073709551615, 2)",
            "(9223372036854775808,)",
        ] {
            let (byte, what) = fault_of(&shape(too_many));
            assert!(
                byte >= values && what.contains("does not fit in 8 bytes"),
                "{what}"
            );
        }
        for (header, byte, word) in [
            (
                "{'descr': '<f4', 'fortran_order': True, 'shape': (2,)}",
                10,
                "Fortran",
            ),
            (
                "{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (2,)}",
                20,
                "such as",
            ),
            (
                "{'descr': 'f4', 'fortran_order': False, 'shape': (2,)}",
                10,
                "unknown type `f4`",
            ),
            (
                "{'descr': '<secret2', 'fortran_order': False, 'shape': (2,)}",
                10,
                "its type is none",
            ),
            (
                "{'descr': '<i4', 'fortran_order': False, 'shape': (2,)}",
                8,
                "type i4",
            ),
            (
                "{'descr': '<f4', 'fortran_order': 0, 'shape': (2,)}",
                44,
                "such as",
            ),
            ("{'descr': '<f4', 'shape': (2,)}", 10, "such as"),
            (
                "{'descr': '<f4', 'fortran_order': False, 'shape': (2,)} 1",
                66,
                "such as",
            ),
            ("", 10, "such as"),
        ] {
            let (at, what) = fault_of(&with_header(header));
            assert!(
                at == byte && what.contains(word),
                "{header}: byte {at}: {what}"
            );
        }
    }

    #[test]
    fn claimed_headers_are_not_believed() {
        let whole = write(&[2], [1.0f32, 2.0]);
        for length in 0..whole.len() {
            read(&whole[..length])
                .and_then(|array| array.values::<f32>())
                .unwrap_err();
        }
        let changed = |at: usize, bytes: &[u8]| {
            let mut file = whole.clone();
            file[at..at + bytes.len()].copy_from_slice(bytes);
            fault_of(&file)
        };
        assert_eq!(changed(6, &[4]).0, 6);
        assert_eq!(changed(8, &[0xff, 0xff]).0, 8);
        assert_eq!(changed(6, &[3, 0, 0xff, 0xff, 0xff, 0xff]).0, 8);
        assert_eq!(changed(8, &[0, 2]).0, whole.len());
        assert_eq!(changed(12, &[0xff]).0, 12);
    }
}
