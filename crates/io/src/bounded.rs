//! Lists and objects in files that may be anybody's, which are read up to a bound: a text of one
//! letter takes four bytes in a file, and 56 in memory.

use std::{collections::BTreeMap, fmt, marker::PhantomData};

use serde::{
    Deserialize, Deserializer,
    de::{DeserializeOwned, DeserializeSeed, Error, MapAccess, SeqAccess, Visitor},
};
use serde_json::value::RawValue;

/// Beginning of the error of a list or an object that is too long.
pub(crate) const MORE_THAN: &str = "more than";

/// Reads a list of at most `MOST` elements (`#[serde(deserialize_with = "bounded::list::<_, _,
/// 20>")]`).
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

/// A list of names in one text, which takes little more memory than it has bytes in a file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    text: String,
    /// End of each name in the text.
    ends: Vec<u32>,
}

impl Names {
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    pub fn iter(&self) -> impl Iterator<Item = &str> {
        let starts = [0].into_iter().chain(self.ends.iter().copied());
        let ranges = starts.zip(&self.ends);
        ranges.map(|(start, &end)| &self.text[start as usize..end as usize])
    }
}

impl<'de> Deserialize<'de> for Names {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut names = Self::default();
        deserializer.deserialize_seq(Appended(&mut names))?;
        Ok(names)
    }
}

/// Appends a name, or those of a list, to others.
struct Appended<'a>(&'a mut Names);

impl<'de> DeserializeSeed<'de> for Appended<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl<'de> Visitor<'de> for Appended<'_> {
    type Value = ();

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str("a list of names")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<(), E> {
        self.0.text.push_str(name);
        let end = u32::try_from(self.0.text.len()).map_err(E::custom)?;
        self.0.ends.push(end);
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<(), A::Error> {
        while list.next_element_seed(Appended(self.0))?.is_some() {}
        Ok(())
    }
}

/// Reads a value of any form from at most `MOST` bytes of JSON.
pub fn text<'de, D: Deserializer<'de>, T: DeserializeOwned, const MOST: usize>(
    deserializer: D,
) -> Result<T, D::Error> {
    // Its length is known before any of its values takes memory.
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
    fn names_are_those_of_the_list() {
        let read = |text: &str| serde_json::from_str::<Names>(text);
        let names = read(r#"["a", "", "\u00e4/b"]"#).unwrap();
        assert_eq!(names.iter().collect::<Vec<_>>(), ["a", "", "ä/b"]);
        assert_eq!(names.len(), 3);
        assert!(read("[]").unwrap().is_empty());
        for wrong in ["\"a\"", "[1]", "[[\"a\"]]", "{}"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
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
