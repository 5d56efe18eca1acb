//! Opens files that a project or the user names.
//!
//! A project may come from a stranger, and its settings name files. Links are followed, for images
//! often live elsewhere, but only a regular file is read: a pipe would block and a device never
//! end, nor may some files of the system that say they are empty. Files that are read whole have a
//! size limit. A file that is mostly a hole costs its sender nothing and the reader minutes, so it
//! is refused; so is a download that stopped after its space was reserved.

use std::{
    fs::{File, Metadata},
    io::{self, Read},
    ops::Range,
    path::Path,
};

use rayon::prelude::*;
use viewrank_core::base::large_pages;

use crate::platform;

/// Kind of a file that is read whole; determines its size limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// `viewrank.toml` and notes of a few lines.
    Settings,
    /// A list of names, such as `clusters.txt`.
    List,
    /// An image, a mask or a depth map.
    Picture,
    Mesh,
    /// Polygons, a box or a closed mesh.
    Region,
    /// A record of a plan or of the files that were written, which is read often.
    Record,
    /// A file of a sparse model.
    Sparse,
    /// A plan, with its exports and pages.
    Plan,
    /// A file of viewrank's own.
    State,
}

impl FileKind {
    /// Size limit, bytes.
    pub const fn limit(self) -> u64 {
        match self {
            Self::Settings => 1 << 20,
            Self::Record => 32 << 20,
            Self::Region => 64 << 20,
            Self::Plan => 128 << 20,
            Self::List => 256 << 20,
            Self::State => 1 << 30,
            Self::Picture => 2 << 30,
            Self::Mesh => 16 << 30,
            Self::Sparse => 64 << 30,
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Settings => "settings",
            Self::List => "a list of names",
            Self::Picture => "an image, a mask or a depth map",
            Self::Mesh => "a mesh",
            Self::Region => "a region",
            Self::Record => "the record of a plan",
            Self::Sparse => "a file of a sparse model",
            Self::Plan => "a plan",
            Self::State => "a file of viewrank's own",
        }
    }
}

/// Bytes that the holes of a file may have together.
const HOLES: u64 = 256 << 20;

/// Opens a regular file, through links or not.
///
/// # Errors
/// Fails with the kind `InvalidInput` for anything else, with `InvalidData` for a file with holes
/// of more than 256 MiB.
pub fn open(path: &Path) -> io::Result<File> {
    open_with_metadata(path).map(|(file, _)| file)
}

fn open_with_metadata(path: &Path) -> io::Result<(File, Metadata)> {
    let mut options = File::options();
    options.read(true);
    platform::never_block(&mut options);
    let file = options.open(path)?;
    // Of the open file: another one may have its name by now.
    let found = file.metadata()?;
    let what = if found.is_dir() {
        "a folder"
    } else if !found.is_file() {
        "a pipe or a device"
    } else if is_endless(&file, found.len())? {
        "one of the system, of unknown length"
    } else {
        check_holes(&file, found.len())?;
        return Ok((file, found));
    };
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        format!("not a regular file but {what}: name a file"),
    ))
}

/// Returns whether a file claims to be empty and isn't, as those of `/proc`; not if it grew just
/// now.
fn is_endless(file: &File, length: u64) -> io::Result<bool> {
    Ok(length == 0 && platform::has_content(file) && file.metadata()?.len() == 0)
}

/// Returns the bytes in holes of a file, if that is more than in any that somebody wrote.
pub fn large_holes(file: &File, length: u64) -> Option<u64> {
    (length > HOLES)
        .then(|| platform::hole_bytes(file, length))
        .filter(|&holes| holes > HOLES)
}

fn check_holes(file: &File, length: u64) -> io::Result<()> {
    let Some(holes) = large_holes(file, length) else {
        return Ok(());
    };
    let holes = holes >> 20;
    let why = format!(
        "{holes} of its {} MiB were never written: copy the file again",
        length >> 20
    );
    Err(io::Error::new(io::ErrorKind::InvalidData, why))
}

/// Identifies a file beyond length and modification time: when its content or name last changed, in
/// ns since 1970 (no program can set that time), and its inode. Where the system has neither, the
/// time of modification and 0.
pub fn identity(metadata: &Metadata) -> (u128, u64) {
    platform::change_and_inode(metadata).unwrap_or_else(|| {
        let modified = metadata.modified().unwrap_or(std::time::UNIX_EPOCH);
        (
            modified
                .duration_since(std::time::UNIX_EPOCH)
                .unwrap_or_default()
                .as_nanos(),
            0,
        )
    })
}

/// The system's error of a walk through folders, without the path that walkdir adds.
pub fn cause(error: walkdir::Error) -> io::Error {
    let is_loop = || io::Error::other("a link leads back to a folder above it");
    error.into_io_error().unwrap_or_else(is_loop)
}

/// Reads a regular file whole, up to the limit of its kind.
pub fn read(path: &Path, kind: FileKind) -> io::Result<Vec<u8>> {
    read_all(open(path)?, kind)
}

/// The mark at the start of a UTF-8 file that some editors of Windows write.
const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// The bytes of a text file without its byte order mark.
pub fn without_mark(mut bytes: Vec<u8>) -> Vec<u8> {
    if bytes.starts_with(BYTE_ORDER_MARK) {
        bytes.drain(..BYTE_ORDER_MARK.len());
    }
    bytes
}

/// Reads a UTF-8 text file whole, up to the limit of its kind, without its byte order mark.
pub fn read_text(path: &Path, kind: FileKind) -> io::Result<String> {
    String::from_utf8(without_mark(read(path, kind)?))
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}

/// Reads an open file whole, up to the limit of its kind.
pub fn read_all(file: File, kind: FileKind) -> io::Result<Vec<u8>> {
    read_first(file, kind, u64::MAX)
}

/// Reads the first `most` bytes of a regular file, or all of them if there are fewer, up to the
/// limit of its kind.
pub fn read_start(path: &Path, kind: FileKind, most: u64) -> io::Result<Vec<u8>> {
    read_first(open(path)?, kind, most)
}

fn read_first(file: File, kind: FileKind, most: u64) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len();
    check_length(length, kind)?;
    let mut bytes = Vec::new();
    // A failed allocation is then an error of this file and not the end of the process.
    bytes.try_reserve_exact(length.min(most) as usize)?;
    // It may grow meanwhile.
    file.take(length.min(most)).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Reads an open file whole on all threads, up to the limit of its kind; most of the time goes into
/// copying and page faults.
///
/// # Errors
/// Fails with the kind `InvalidData` if the length changes meanwhile.
pub fn read_large(file: &File, kind: FileKind) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len();
    check_length(length, kind)?;
    let changed = || {
        io::Error::new(
            io::ErrorKind::InvalidData,
            "it changed while it was read: try again once it is complete",
        )
    };
    let bytes = read_range(file, 0..length).map_err(|error| match error.kind() {
        io::ErrorKind::UnexpectedEof => changed(),
        _ => error,
    })?;
    if file.metadata()?.len() == length {
        Ok(bytes)
    } else {
        Err(changed())
    }
}

/// Reads a range of bytes of a file on all threads.
pub fn read_range(file: &File, range: Range<u64>) -> io::Result<Vec<u8>> {
    // Small in tests, so that their files have several parts.
    const PART: usize = if cfg!(test) { 4 } else { 8 << 20 };
    let length = range.end.saturating_sub(range.start);
    let mut bytes = large_pages::try_zeroed(usize::try_from(length).unwrap_or(usize::MAX))?;
    let parts = bytes.par_chunks_mut(PART).enumerate();
    parts.try_for_each(|(n, part)| {
        platform::read_exact_at(file, part, range.start + (n * PART) as u64)
    })?;
    Ok(bytes)
}

/// Checks that a file of `length` bytes is within the limit of its kind.
pub fn check_length(length: u64, kind: FileKind) -> io::Result<()> {
    if length <= kind.limit() {
        return Ok(());
    }
    let why = format!(
        "larger than {} MiB, the limit for {}: give a smaller file",
        kind.limit() >> 20,
        kind.name()
    );
    Err(io::Error::new(io::ErrorKind::FileTooLarge, why))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_part_of_a_file_is_read_whatever_its_length() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("file");
        let bytes: Vec<u8> = (0..99).collect();
        std::fs::write(&path, &bytes).unwrap();
        let file = open(&path).unwrap();
        for (start, end) in [(0, 99), (0, 0), (7, 8), (3, 11), (50, 99), (99, 99)] {
            assert_eq!(
                read_range(&file, start as u64..end as u64).unwrap(),
                bytes[start..end],
                "{start} to {end}"
            );
        }
        assert_eq!(
            read_range(&file, 90..100).unwrap_err().kind(),
            io::ErrorKind::UnexpectedEof
        );
        assert_eq!(read_large(&file, FileKind::State).unwrap(), bytes);
    }

    #[test]
    fn only_regular_files_are_opened_links_to_them_included() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let [file, link, pipe] = ["file", "link", "pipe"].map(|name| folder.path().join(name));
        std::fs::write(&file, "text").expect("a file");
        std::os::unix::fs::symlink("file", &link).expect("a link");
        assert!(
            std::process::Command::new("mkfifo")
                .arg(&pipe)
                .status()
                .expect("mkfifo")
                .success()
        );
        assert_eq!(
            read_text(&link, FileKind::Settings).expect("the file"),
            "text"
        );
        for path in [&pipe, Path::new("/dev/zero"), folder.path()] {
            let error = read(path, FileKind::Settings).expect_err("refused");
            assert_eq!(
                error.kind(),
                io::ErrorKind::InvalidInput,
                "{}",
                path.display()
            );
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_file_of_unknown_length_is_refused_and_an_empty_one_is_not() {
        for path in ["/proc/self/pagemap", "/proc/uptime"] {
            let error = open(Path::new(path)).expect_err(path);
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{path}");
        }
        let empty = tempfile::NamedTempFile::new().expect("a temporary file");
        assert_eq!(read(empty.path(), FileKind::List).expect("empty"), b"");
    }

    #[test]
    fn a_file_above_the_limit_is_not_read() {
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        file.as_file()
            .set_len(FileKind::Settings.limit())
            .expect("a length");
        assert_eq!(
            read(file.path(), FileKind::Settings)
                .expect("just so")
                .len() as u64,
            FileKind::Settings.limit()
        );
        file.as_file()
            .set_len(FileKind::Settings.limit() + 1)
            .expect("a length");
        let error = read(file.path(), FileKind::Settings).expect_err("too large");
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        assert!(error.to_string().contains(" 1 MiB"), "{error}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn holes_are_counted_together_and_refused() {
        use std::os::unix::fs::FileExt;
        let file = tempfile::NamedTempFile::new().expect("a temporary file");
        let written = |length: u64, data: &[u8], places: u64| {
            file.as_file()
                .set_len(0)
                .and_then(|()| file.as_file().set_len(length))
                .expect("a length");
            (0..places).for_each(|i| {
                file.as_file()
                    .write_all_at(data, i * length / places)
                    .expect("data")
            });
            open(file.path())
        };
        let mut start = [0];
        let mut just_so = written(HOLES + (1 << 20), &[7; 1 << 20], 1).expect("not mostly holes");
        just_so.read_exact(&mut start).expect("read from the start");
        assert_eq!(start, [7]);
        for places in [0, 1, 64] {
            let error = written(40 << 30, b"data", places).expect_err("mostly holes");
            assert_eq!(error.kind(), io::ErrorKind::InvalidData);
            assert!(
                error
                    .to_string()
                    .contains("of its 40960 MiB were never written"),
                "{error}"
            );
        }
    }
}
