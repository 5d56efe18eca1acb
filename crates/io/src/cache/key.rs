//! The key of the user, with which caches are signed: a project may come from a stranger, with
//! caches that say anything for the right inputs. It is made at first use, in the user's folder for
//! caches.

use std::{
    fmt, fs,
    io::{self, Write},
    path::{Path, PathBuf},
    sync::OnceLock,
};

use etcetera::BaseStrategy;

use crate::{
    input::{self, FileKind},
    paths::is_outside,
    platform,
};

#[derive(Clone, Copy, PartialEq)]
pub(super) struct Key(pub [u8; 32]);

/// A secret: what prints a plan must not print it.
impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("Key")
    }
}

/// Returns the key; `None` where it cannot be kept, or is in the project, which may have brought
/// it.
pub(super) fn of_user(project: &Path) -> Option<Key> {
    static KEY: OnceLock<Option<(PathBuf, Key)>> = OnceLock::new();
    let found = || {
        let caches = etcetera::choose_base_strategy().ok()?.cache_dir();
        // A relative home is anybody's.
        let folder = Some(caches.join("viewrank")).filter(|folder| folder.is_absolute())?;
        let key = read_or_make(&folder).ok()?;
        Some((folder, key))
    };
    let (folder, key) = KEY.get_or_init(found).as_ref()?;
    is_outside(folder, project).then_some(*key)
}

/// Returns whether no other user may read the key, as far as its file system knows users: on one
/// that gives all files the same permissions, they cannot be taken away.
fn is_private(path: &Path, found: &fs::Metadata) -> bool {
    if platform::is_private(found) {
        return true;
    }
    platform::make_private(path).is_ok()
        && path
            .metadata()
            .is_ok_and(|found| !platform::is_private(&found))
}

fn read_or_make(folder: &Path) -> io::Result<Key> {
    let path = folder.join("cache.key");
    let read = || {
        let file = input::open(&path)?;
        let found = file.metadata()?;
        // Who knows the key can make caches that are believed.
        if !platform::is_own(&found) {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        let bytes: Result<[u8; 32], _> = input::read_all(file, FileKind::State)?.try_into();
        let key = bytes.ok().filter(|_| is_private(&path, &found));
        key.map(Key)
            .ok_or_else(|| io::Error::from(io::ErrorKind::InvalidData))
    };
    let is_damaged = match read() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        // Cut off by a loss of power, or to be read by others.
        Err(error) if error.kind() == io::ErrorKind::InvalidData => true,
        found => return found,
    };
    let mut key = Key([0; 32]);
    getrandom::fill(&mut key.0)?;
    fs::create_dir_all(folder)?;
    // Readable for the user alone.
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(&key.0)?;
    file.as_file().sync_all()?;
    if is_damaged {
        file.persist(&path)?;
        return Ok(key);
    }
    match file.persist_noclobber(&path) {
        // Another process was first.
        Err(error) if error.error.kind() == io::ErrorKind::AlreadyExists => read(),
        Err(error) => Err(error.error),
        Ok(_) => Ok(key),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_made_once_for_its_user_alone() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("new/viewrank");
        let key = read_or_make(&place).unwrap();
        assert_eq!(read_or_make(&place).unwrap(), key);
        let other = read_or_make(folder.path()).unwrap();
        assert!(other != key && key != Key([0; 32]));
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = fs::metadata(place.join("cache.key")).unwrap().permissions();
            assert_eq!(mode.mode() & 0o777, 0o600);
        }
    }

    #[test]
    fn a_damaged_key_is_made_again() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("cache.key"), "short").unwrap();
        let key = read_or_make(folder.path()).unwrap();
        assert_eq!(read_or_make(folder.path()).unwrap(), key);
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        assert!(read_or_make(&file.join("below")).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_key_that_others_may_know_is_not_taken() {
        use std::os::unix::fs::{PermissionsExt, chown};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cache.key");
        let key = read_or_make(folder.path()).unwrap();
        for mode in [0o644, 0o620] {
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            assert!(read_or_make(folder.path()).unwrap() != key, "{mode:o}");
        }
        // Only root can give files away.
        if chown(&path, Some(12_345), None).is_ok() {
            assert!(read_or_make(folder.path()).is_err());
        }
    }
}
