//! Lists and objects in files that may be anybody's, which are read up to a bound: an empty text
//! takes three bytes in a file, and 24 in memory.

use std::{collections::BTreeMap, fmt, marker::PhantomData};

use serde::{
    Deserialize, Deserializer,
    de::{DeserializeOwned, Error, MapAccess, SeqAccess, Visitor},
};
use serde_json::value::RawValue;

/// Beginning of the error of a list or an object that is too long.
pub(crate) const MORE_THAN: &str = "more than";

/// Reads a list of at most `MOST` elements (`#[serde(deserialize_with = "bounded::list::<_, _, 20>")]`).
pub fn list<'de, D: Deserializer<'de>, T: Deserialize<'de>, const MOST: usize>(
    deserializer: D,
) -> Result<Vec<T>, D::Error> {
    deserializer.deserialize_seq(Bounded::<T, MOST>(PhantomData))
}

/// Reads an object of at most `MOST` entries, like [`list`].
pub fn map<'de, D: Deserializer<'de>, T: Deserialize<'de>, const MOST: usize>(
    deserializer: D,
) -> Result<BTreeMap<String, T>, D::Error> {
    deserializer.deserialize_map(Map::<T, MOST>(PhantomData))
}

/// Reads the elements of a list, at most `MOST`.
pub fn elements<'de, A: SeqAccess<'de>, T: Deserialize<'de>, const MOST: usize>(
    mut elements: A,
) -> Result<Vec<T>, A::Error> {
    let mut list = Vec::new();
    while let Some(element) = elements.next_element()? {
        if list.len() == MOST {
            return Err(too_many(MOST));
        }
        list.push(element);
    }
    Ok(list)
}

/// Reads a value of any form from at most `MOST` bytes of JSON.
pub fn text<'de, D: Deserializer<'de>, T: DeserializeOwned, const MOST: usize>(
    deserializer: D,
) -> Result<T, D::Error> {
    let text = Box::<RawValue>::deserialize(deserializer)?;
    if text.get().len() > MOST {
        return Err(D::Error::custom(format_args!("{MORE_THAN} {MOST} bytes")));
    }
    serde_json::from_str(text.get()).map_err(D::Error::custom)
}

/// The error of a list or an object with more than `most` entries.
pub fn too_many<E: Error>(most: usize) -> E {
    E::custom(format_args!("{MORE_THAN} {most} entries"))
}

struct Bounded<T, const MOST: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const MOST: usize> Visitor<'de> for Bounded<T, MOST> {
    type Value = Vec<T>;

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        write!(formatter, "a list of at most {MOST}")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Vec<T>, A::Error> {
        elements::<A, T, MOST>(list)
    }
}

struct Map<T, const MOST: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const MOST: usize> Visitor<'de> for Map<T, MOST> {
    type Value = BTreeMap<String, T>;

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        write!(formatter, "an object of at most {MOST} entries")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Self::Value, A::Error> {
        let mut map = BTreeMap::new();
        while let Some((key, value)) = entries.next_entry()? {
            map.insert(key, value);
            if map.len() > MOST {
                return Err(too_many(MOST));
            }
        }
        Ok(map)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Deserialize)]
    struct Short(#[serde(deserialize_with = "super::list::<_, _, 2>")] Vec<u8>);

    #[derive(Debug, PartialEq, Deserialize)]
    struct Small(#[serde(deserialize_with = "super::map::<_, _, 1>")] BTreeMap<String, u8>);

    #[test]
    fn a_list_that_is_too_long_is_refused() {
        let read = |text: &str| serde_json::from_str::<Short>(text).ok();
        assert_eq!(read("[1,2]"), Some(Short(vec![1, 2])));
        assert_eq!(read("[]"), Some(Short(Vec::new())));
        assert_eq!(read("[1,2,3]"), None);
    }

    #[test]
    fn a_text_that_is_too_long_is_refused_whatever_it_holds() {
        #[derive(Debug, PartialEq, Deserialize)]
        struct Brief(#[serde(deserialize_with = "super::text::<_, _, 8>")] Vec<u8>);
        let read = |text: &str| serde_json::from_str::<Brief>(text).ok();
        assert_eq!(read("[1,2,30]"), Some(Brief(vec![1, 2, 30])));
        assert_eq!(read("[1,2,3,4]"), None);
        assert_eq!(read("[1,2,x]"), None);
    }

    #[test]
    fn an_object_with_too_many_entries_is_refused() {
        let read = |text: &str| serde_json::from_str::<Small>(text).ok();
        assert_eq!(
            read(r#"{"a":1}"#),
            Some(Small([("a".to_owned(), 1)].into()))
        );
        assert_eq!(read("{}"), Some(Small(BTreeMap::new())));
        assert_eq!(read(r#"{"a":1,"b":2}"#), None);
    }
}
