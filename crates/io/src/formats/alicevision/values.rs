//! Values of SfMData, which are written as text: numbers in quotes, an empty string for an empty
//! list.

use std::{fmt, marker::PhantomData, str::FromStr};

use serde::{
    Deserialize, Deserializer,
    de::{Error, IntoDeserializer, SeqAccess, Visitor, value::SeqAccessDeserializer},
};

use crate::{bounded, formats::Problem};

/// A number, possibly in quotes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Number<T>(pub T);

impl<'de, T: FromStr> Deserialize<'de> for Number<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Quoted(PhantomData))
    }
}

struct Quoted<T>(PhantomData<T>);

impl<T: FromStr> Visitor<'_> for Quoted<T> {
    type Value = Number<T>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a number, possibly in quotes")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
        // Booleans are also written as 0 and 1.
        let is_boolean = size_of::<T>() == 1;
        let text = match text {
            "0" if is_boolean => "false",
            "1" if is_boolean => "true",
            _ => text,
        };
        text.parse()
            .map(Number)
            .map_err(|_| E::custom(format!("{text:?} is not a valid number")))
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Self::Value, E> {
        // By its text, since any type that can be parsed may be wanted.
        self.visit_str(&value.to_string())
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Self::Value, E> {
        self.visit_str(&value.to_string())
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Self::Value, E> {
        self.visit_str(&value.to_string())
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Self::Value, E> {
        self.visit_str(&value.to_string())
    }
}

/// A list of at most `MOST` elements; an empty one is written as an empty string.
#[derive(Clone, Debug)]
pub(super) struct List<T, const MOST: usize = { usize::MAX }>(pub Vec<T>);

impl<T, const MOST: usize> Default for List<T, MOST> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<'de, T: Deserialize<'de>, const MOST: usize> Deserialize<'de> for List<T, MOST> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Elements(PhantomData))
    }
}

struct Elements<T, const MOST: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const MOST: usize> Visitor<'de> for Elements<T, MOST> {
    type Value = List<T, MOST>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a list, or an empty string")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
        if text.is_empty() {
            Ok(List::default())
        } else {
            Err(E::custom("expected a list"))
        }
    }

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Self::Value, A::Error> {
        bounded::elements::<A, T, MOST>(list).map(List)
    }
}

impl List<Number<f64>> {
    pub fn numbers<const N: usize>(&self, what: &'static str) -> Result<[f64; N], Problem> {
        let wrong = || {
            Problem::Content(format!(
                "{what} has {} numbers instead of {N}",
                self.0.len()
            ))
        };
        let numbers: Vec<f64> = self.0.iter().map(|n| n.0).collect();
        numbers.try_into().map_err(|_| wrong())
    }
}

/// Focal length: one number up to version 1.1, a list of two since.
pub(super) enum OneOrTwo {
    One(Number<f64>),
    Two(List<Number<f64>>),
}

impl<'de> Deserialize<'de> for OneOrTwo {
    /// Not as an untagged enumeration, which keeps all of a list to try it twice.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Either)
    }
}

struct Either;

impl<'de> Visitor<'de> for Either {
    type Value = OneOrTwo;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a number or a list of two")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
        Number::deserialize(text.into_deserializer()).map(OneOrTwo::One)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Self::Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Self::Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Self::Value, E> {
        Ok(OneOrTwo::One(Number(value)))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Self::Value, A::Error> {
        List::deserialize(SeqAccessDeserializer::new(list)).map(OneOrTwo::Two)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::foreign::json;

    #[test]
    fn a_focal_length_is_one_number_or_two_and_read_once() {
        let read = |text: &str| match json::<OneOrTwo>(text.as_bytes()) {
            Ok(OneOrTwo::One(f)) => Ok(vec![f.0]),
            Ok(OneOrTwo::Two(list)) => Ok(list.0.iter().map(|f| f.0).collect()),
            Err(fault) => Err(fault.to_string()),
        };
        for (text, expected) in [
            ("5", vec![5.0]),
            ("\"5.5\"", vec![5.5]),
            ("[\"4\", 5]", vec![4.0, 5.0]),
        ] {
            assert_eq!(read(text), Ok(expected), "{text}");
        }
        // The error is that of an element, not that nothing fits the whole.
        let error = read("[0, \"x\", 0").unwrap_err();
        assert!(error.contains("\"x\" is not a valid number"), "{error}");
    }
}
