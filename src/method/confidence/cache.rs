//! Cache of confidence maps, so that unchanged images are not read again.
//!
//! File format: a line of magic, a line of JSON that lists the entries, the maps with 1 byte per cell one after the other, and BLAKE3 of everything
//! before. A file that is damaged, of another version or of another predictor counts as empty: it is only a cache.

use std::{
    collections::BTreeMap,
    fs, io,
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

use serde::{Deserialize, Serialize};

use super::{ConfidenceMap, Prediction};
use crate::{base::input, io::output};

const MAGIC: &[u8] = b"viewrank confidence maps 2\n";

/// Identity of a file at the time it was read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stamp {
    size: u64,
    /// Modification time since 1970; 0 if unknown, which no file matches.
    nanoseconds: u64,
    /// Time of the last change to content or name, since 1970, which no program can set; on systems without it, the modification time.
    changed: u64,
    /// BLAKE3 of the contents, hexadecimal.
    content: String,
}

impl Stamp {
    /// Reads size and times of a file, not its contents.
    pub fn read(path: &Path) -> io::Result<Self> {
        let metadata = fs::metadata(path)?;
        let since = metadata.modified().unwrap_or(UNIX_EPOCH).duration_since(SystemTime::UNIX_EPOCH);
        let nanoseconds = since.map_or(0, |since| since.as_nanos() as u64);
        let changed = input::identity(&metadata).0 as u64;
        Ok(Self { size: metadata.len(), nanoseconds, changed, content: String::new() })
    }

    /// Adds the hash of the contents.
    pub fn with_content(self, bytes: &[u8]) -> Self {
        Self { content: blake3::hash(bytes).to_string(), ..self }
    }

    /// Returns whether size and times are equal: nobody has written to the file.
    fn is_untouched(&self, now: &Self) -> bool {
        let of = |stamp: &Self| (stamp.size, stamp.nanoseconds, stamp.changed);
        self.nanoseconds != 0 && of(self) == of(now)
    }
}

/// Image and mask of a view; `None` where it lacks them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Inputs {
    pub image: Option<Stamp>,
    pub mask: Option<Stamp>,
}

impl Inputs {
    fn each<'a>(&'a self, other: &'a Self) -> [(&'a Option<Stamp>, &'a Option<Stamp>); 2] {
        [(&self.image, &other.image), (&self.mask, &other.mask)]
    }

    /// Returns whether the file system records the time of change of each.
    pub fn are_dated(&self) -> bool {
        [&self.image, &self.mask].into_iter().flatten().all(|stamp| stamp.nanoseconds != 0)
    }

    /// Compares sizes and times.
    fn are_untouched(&self, now: &Self) -> bool {
        self.each(now).iter().all(|pair| match pair {
            (Some(then), Some(now)) => then.is_untouched(now),
            (then, now) => then.is_none() && now.is_none(),
        })
    }

    /// Compares contents.
    fn are_the_same(&self, now: &Self) -> bool {
        let content = |stamp: &Option<Stamp>| stamp.as_ref().map(|s| s.content.clone());
        self.each(now).iter().all(|(then, now)| content(then) == content(now))
    }
}

/// The map of a view, with the files it was made from.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    pub inputs: Inputs,
    pub predicted: Prediction,
}

/// Maps of one predictor, by view name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cache {
    entries: BTreeMap<String, Entry>,
}

#[derive(Serialize, Deserialize)]
struct Listing {
    /// Fingerprint of the predictor, hexadecimal.
    predictor: String,
    maps: Vec<Listed>,
}

#[derive(Serialize, Deserialize)]
struct Listed {
    name: String,
    inputs: Inputs,
    distance: f32,
    grid: [u32; 2],
}

impl Cache {
    pub fn new(entries: impl Iterator<Item = (String, Entry)>) -> Self {
        Self { entries: entries.collect() }
    }

    /// Reads the project's file `name`; empty if there is no intact file of this predictor.
    pub fn read(project: &Path, name: &str, predictor: &str) -> Self {
        output::read_own(project, name).ok().and_then(|bytes| Self::parse(&bytes, predictor)).unwrap_or_default()
    }

    /// Returns the entry of a view whose files have unchanged sizes and times.
    pub fn untouched(&self, name: &str, now: &Inputs) -> Option<&Entry> {
        self.entries.get(name).filter(|entry| entry.inputs.are_untouched(now))
    }

    /// Returns the entry of a view whose files have the same contents.
    pub fn same(&self, name: &str, now: &Inputs) -> Option<&Entry> {
        self.entries.get(name).filter(|entry| entry.inputs.are_the_same(now))
    }

    fn parse(bytes: &[u8], predictor: &str) -> Option<Self> {
        let (body, hash) = bytes.split_last_chunk::<32>()?;
        let rest = body.strip_prefix(MAGIC).filter(|_| blake3::hash(body) == *hash)?;
        let line = rest.iter().position(|&b| b == b'\n')?;
        let listing: Listing = serde_json::from_slice(&rest[..line]).ok()?;
        let mut maps = &rest[line + 1..];
        let mut entries = BTreeMap::new();
        for Listed { name, inputs, distance, grid } in listing.maps {
            let cells = usize::try_from(u64::from(grid[0]) * u64::from(grid[1])).ok()?;
            let (map, others) = maps.split_at_checked(cells)?;
            maps = others;
            let map = ConfidenceMap::from_bytes(grid, map.to_vec())?;
            entries.insert(name, Entry { inputs, predicted: Prediction { map, distance } });
        }
        (listing.predictor == predictor).then_some(Self { entries })
    }

    pub fn to_bytes(&self, predictor: &str) -> Vec<u8> {
        let listed = |(name, entry): (&String, &Entry)| Listed {
            name: name.clone(),
            inputs: entry.inputs.clone(),
            distance: entry.predicted.distance,
            grid: [entry.predicted.map.columns, entry.predicted.map.rows],
        };
        let listing = Listing { predictor: predictor.into(), maps: self.entries.iter().map(listed).collect() };
        let mut bytes = MAGIC.to_vec();
        bytes.extend(serde_json::to_vec(&listing).expect("text and finite numbers are JSON"));
        bytes.push(b'\n');
        self.entries.values().for_each(|entry| bytes.extend(entry.predicted.map.bytes()));
        let hash = blake3::hash(&bytes);
        bytes.extend(hash.as_bytes());
        bytes
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn cache() -> Cache {
        let map = ConfidenceMap::new([3, 2], [0.0, 0.2, 0.4, 0.6, 0.8, 1.0].into_iter());
        let stamp = Stamp { size: 7, nanoseconds: 5, changed: 5, content: "c".into() };
        let inputs = Inputs { image: Some(stamp), mask: None };
        let entry = Entry { inputs, predicted: Prediction { map, distance: 0.5 } };
        Cache::new([("sub/a \u{fc}.jpg".to_string(), entry)].into_iter())
    }

    #[test]
    fn what_is_written_is_read_by_the_same_predictor() {
        let bytes = cache().to_bytes("p");
        assert_eq!(Cache::parse(&bytes, "p"), Some(cache()));
        assert_eq!(Cache::parse(&bytes, "q"), None);
    }

    #[test]
    fn a_touched_file_is_known_by_its_content() {
        let cache = cache();
        let name = "sub/a \u{fc}.jpg";
        let image = |nanoseconds, content: &str| Inputs {
            image: Some(Stamp { size: 7, nanoseconds: 5, changed: nanoseconds, content: content.into() }),
            mask: None,
        };
        assert!(cache.untouched(name, &image(5, "")).is_some());
        assert!(cache.untouched(name, &image(6, "c")).is_none());
        assert!(cache.same(name, &image(6, "c")).is_some());
        assert!(cache.same(name, &image(6, "d")).is_none());
        // A mask was added.
        let masked = Inputs { mask: image(1, "m").image, ..image(5, "c") };
        assert!(cache.untouched(name, &masked).is_none() && cache.same(name, &masked).is_none());
    }

    proptest! {
        #[test]
        fn a_damaged_cache_is_empty(at in 0usize..400, change in 1u8.., keep in 0usize..400) {
            let mut bytes = cache().to_bytes("p");
            prop_assume!(keep < bytes.len());
            prop_assert_eq!(Cache::parse(&bytes[..keep], "p"), None);
            let at = at % bytes.len();
            bytes[at] ^= change;
            prop_assert_eq!(Cache::parse(&bytes, "p"), None);
        }
    }
}
