//! Results that a project keeps for its next plan: files in `viewrank/cache`, each believed only
//! for the inputs that it was made from, and only by the user who made it: they are signed.
//!
//! One file: a line of magic, a line of JSON with facts and the fingerprints of the inputs and of
//! the rest, and the contents. A file that is damaged, or was made from other inputs, by another
//! user or by another version of the format, counts as absent. They are written together with the
//! plan ([`super::output`]).

mod key;

use std::{
    io::{BufRead, BufReader, Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use self::key::Key;
use super::output::{self, Contents, FileSet};
use crate::{
    input::{self, FileKind},
    packed::Packed,
};

const MAGIC: &str = "viewrank cache 2\n";
/// Limit for the line of JSON, bytes: a few per view, and warnings.
const LONGEST_HEAD: u64 = 64 << 20;
/// Bytes read or hashed at once.
const BLOCK: usize = 1 << 20;

/// A file of the cache.
#[derive(Clone, Debug, PartialEq)]
pub struct CacheFile {
    home: PathBuf,
    path: &'static str,
    /// BLAKE3 of what the contents depend on, hexadecimal; `None` if that is not known, or the user
    /// has no key: such contents are neither written nor read.
    inputs: Option<String>,
    key: Option<Key>,
}

#[derive(Serialize, Deserialize)]
struct Head<F> {
    inputs: String,
    /// Keyed BLAKE3 of all the rest, hexadecimal.
    hash: String,
    facts: F,
}

/// A file whose inputs are those expected, being read.
pub struct OpenCache<F> {
    /// Small results, not yet checked.
    pub facts: F,
    file: BufReader<std::fs::File>,
    hash: String,
    hasher: blake3::Hasher,
}

impl CacheFile {
    /// `home`: of the project. `inputs`: has seen everything that the contents depend on, the
    /// program included; `None` if that is not known.
    pub fn new(home: &Path, path: &'static str, inputs: Option<blake3::Hasher>) -> Self {
        Self::signed(home, path, inputs, key::of_user(home))
    }

    fn signed(
        home: &Path,
        path: &'static str,
        inputs: Option<blake3::Hasher>,
        key: Option<Key>,
    ) -> Self {
        let inputs = inputs.filter(|_| key.is_some());
        Self {
            home: home.into(),
            path,
            inputs: inputs.map(|inputs| inputs.finalize().to_string()),
            key,
        }
    }

    /// Returns the hasher of the file, which has seen all but its contents; `None` without a key.
    fn hasher(&self, inputs: &str, facts: &impl Serialize) -> Option<blake3::Hasher> {
        // With its path, so that no file passes for another one.
        let json = serde_json::to_vec(&(self.path, inputs, facts));
        let mut hasher = blake3::Hasher::new_keyed(&self.key?.0);
        hasher.update(&json.expect("numbers and texts are JSON"));
        Some(hasher)
    }

    /// Fingerprint of what the contents depend on, so that other results can depend on them.
    pub fn inputs(&self) -> Option<&str> {
        self.inputs.as_deref()
    }

    /// Opens the file if it was made from the same inputs.
    pub fn open<F: Serialize + DeserializeOwned>(&self) -> Option<OpenCache<F>> {
        let inputs = self.inputs.as_ref()?;
        let mut file =
            BufReader::with_capacity(BLOCK, output::open_own(&self.home, self.path).ok()?);
        // A planted file may be one line of any length.
        let mut line = |most| {
            let mut text = String::new();
            file.by_ref().take(most).read_line(&mut text).ok()?;
            Some(text)
        };
        if line(MAGIC.len() as u64)? != MAGIC {
            return None;
        }
        let head: Head<F> = serde_json::from_str(&line(LONGEST_HEAD)?).ok()?;
        let hasher = self.hasher(inputs, &head.facts)?;
        (head.inputs == *inputs).then_some(OpenCache {
            facts: head.facts,
            file,
            hash: head.hash,
            hasher,
        })
    }

    /// Reads facts and contents if the file was made from the same inputs and is undamaged.
    pub fn read<F: Serialize + DeserializeOwned>(&self) -> Option<(F, Vec<u8>)> {
        let mut open = self.open()?;
        let length = open.file.get_ref().metadata().ok()?.len();
        input::check_length(length, FileKind::State).ok()?;
        let start = open.file.stream_position().ok()?;
        let bytes = input::read_range(open.file.get_ref(), start..length).ok()?;
        open.hasher.update_rayon(&bytes);
        // `checked` asks whether the reader is at the end.
        open.file.seek(SeekFrom::Start(length)).ok()?;
        open.checked().map(|facts| (facts, bytes))
    }

    /// Makes the file; if the inputs are not known, as [`Self::no_file`].
    pub fn file(&self, facts: &impl Serialize, contents: Packed) -> FileSet {
        let inputs = self.inputs.clone();
        let signed = inputs.and_then(|inputs| Some((self.hasher(&inputs, facts)?, inputs)));
        let Some((mut hasher, inputs)) = signed else {
            return self.no_file();
        };
        for part in &contents {
            for block in part.as_bytes().chunks(BLOCK) {
                hasher.update(block);
                // Rows on disk would otherwise all stay in memory.
                part.release();
            }
        }
        let head = Head {
            inputs,
            hash: hasher.finalize().to_string(),
            facts,
        };
        let json = serde_json::to_string(&head).expect("numbers and texts are JSON");
        let mut set = self.no_file();
        set.add(
            self.path,
            Contents::Table {
                head: [MAGIC, &json, "\n"].concat().into_bytes(),
                rows: contents,
            },
        );
        set
    }

    /// Returns the set whose writing removes the file, which is of other inputs; of a user without
    /// a key, one that leaves the files of others alone.
    pub fn no_file(&self) -> FileSet {
        if self.key.is_none() {
            return FileSet::new(&self.home, "none");
        }
        let name = self
            .path
            .rsplit('/')
            .next()
            .and_then(|name| name.split('.').next())
            .unwrap_or(self.path);
        FileSet {
            is_spare: true,
            ..FileSet::new(&self.home, name)
        }
    }
}

impl<F> OpenCache<F> {
    /// Reads the next part of the contents.
    pub fn fill(&mut self, part: &mut [u8]) -> Option<()> {
        self.file.read_exact(part).ok()?;
        self.hasher.update(part);
        Some(())
    }

    /// Returns the facts if all contents were read, and both are those written.
    pub fn checked(mut self) -> Option<F> {
        // Bytes behind the contents were never signed.
        let is_at_end = self.file.fill_buf().is_ok_and(<[u8]>::is_empty);
        (is_at_end && self.hasher.finalize().to_string() == self.hash).then_some(self.facts)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::output::Disk;
    use viewrank_core::base::column::Column;

    const PATH: &str = "viewrank/cache/some.table";

    fn packed(bytes: &[u8]) -> Packed {
        vec![Arc::new(Column::from(bytes.to_vec()))]
    }

    fn of(home: &Path, input: &[u8]) -> CacheFile {
        signed(home, input, Some(Key([1; 32])))
    }

    fn signed(home: &Path, input: &[u8], key: Option<Key>) -> CacheFile {
        let mut inputs = blake3::Hasher::new();
        inputs.update(input);
        CacheFile::signed(home, PATH, Some(inputs), key)
    }

    fn write(set: FileSet) {
        set.write(&Disk::REAL).unwrap();
    }

    #[test]
    fn what_was_kept_is_read_for_the_same_inputs_alone() {
        let home = tempfile::tempdir().unwrap();
        let file = of(home.path(), b"a");
        assert!(file.read::<u32>().is_none());
        write(file.file(&7, packed(&[1, 2, 3])));
        assert_eq!(file.read::<u32>(), Some((7, vec![1, 2, 3])));
        assert!(of(home.path(), b"b").read::<u32>().is_none());
        assert!(file.read::<String>().is_none(), "other facts");
        write(file.no_file());
        assert!(!home.path().join(PATH).exists());
    }

    #[test]
    fn nothing_is_kept_for_unknown_inputs() {
        let home = tempfile::tempdir().unwrap();
        write(of(home.path(), b"a").file(&7, packed(&[1])));
        let file = CacheFile::signed(home.path(), PATH, None, Some(Key([1; 32])));
        assert!(file.read::<u32>().is_none());
        write(file.file(&7, packed(&[1])));
        assert!(!home.path().join(PATH).exists());
    }

    #[test]
    fn nobody_believes_the_file_of_another_user() {
        let home = tempfile::tempdir().unwrap();
        let [one, other, none] = [Some(Key([1; 32])), Some(Key([2; 32])), None]
            .map(|key| signed(home.path(), b"a", key));
        write(one.file(&7, packed(&[1])));
        assert!(other.read::<u32>().is_none() && none.read::<u32>().is_none());
        write(none.file(&8, packed(&[2])));
        assert_eq!(one.read::<u32>().map(|(facts, _)| facts), Some(7));
    }

    #[test]
    fn no_changed_byte_is_believed() {
        let home = tempfile::tempdir().unwrap();
        let file = of(home.path(), b"a");
        write(file.file(&7, packed(&[1; 50])));
        let good = std::fs::read(home.path().join(PATH)).unwrap();
        for place in 0..good.len() {
            let mut bad = good.clone();
            bad[place] ^= 0x10;
            std::fs::write(home.path().join(PATH), &bad).unwrap();
            assert!(file.read::<u32>().is_none(), "{place}");
        }
        for bad in [&good[..good.len() - 1], &[&good[..], &[1]].concat()] {
            std::fs::write(home.path().join(PATH), bad).unwrap();
            assert!(file.read::<u32>().is_none());
        }
    }

    /// Also by those who read it part by part, and know how many bytes there should be.
    #[test]
    fn a_longer_file_is_not_believed() {
        let home = tempfile::tempdir().unwrap();
        let file = of(home.path(), b"a");
        write(file.file(&7, packed(&[1; 50])));
        let facts = || {
            let mut open = file.open::<u32>().unwrap();
            open.fill(&mut [0; 50]).unwrap();
            open.checked()
        };
        assert_eq!(facts(), Some(7));
        let path = home.path().join(PATH);
        std::fs::write(&path, [std::fs::read(&path).unwrap(), vec![1]].concat()).unwrap();
        assert_eq!(facts(), None);
    }
}
