//! Columns of the large tables: rows are appended while a stage runs and only read from then on, in
//! memory or, where memory is short, in an unlinked temporary file that the system reads page by
//! page.

use std::{
    env,
    fs::File,
    io::{self, Write},
    ops::Deref,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

use bytemuck::Pod;
use memmap2::Mmap;
use rayon::prelude::*;

use crate::base::{
    error::{Advice, Hint},
    progress::Cancelled,
};

/// Place of the columns: in memory or on disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Storage {
    #[default]
    Memory,
    /// In an unlinked temporary file in `$TMPDIR`, else in `/var/tmp`; the system frees it when the
    /// process ends.
    Disk,
}

/// A finished column, in memory or on disk; read as a slice. Clones share the rows.
#[derive(Clone)]
pub struct Column<T>(Backing<T>);

#[derive(Clone)]
enum Backing<T> {
    Memory(Arc<Vec<T>>),
    Disk(Arc<Mmap>),
}

impl<T> Column<T> {
    pub fn storage(&self) -> Storage {
        match self.0 {
            Backing::Memory(_) => Storage::Memory,
            Backing::Disk(_) => Storage::Disk,
        }
    }

    /// Bytes of heap memory; 0 for a column on disk, whose pages the system may drop.
    pub fn bytes(&self) -> usize {
        match &self.0 {
            Backing::Memory(list) => size_of_val(&list[..]),
            Backing::Disk(_) => 0,
        }
    }

    /// Returns the rows to be changed, if they are in memory and nobody shares them; else the
    /// column.
    pub fn into_rows(self) -> Result<Vec<T>, Self> {
        match self.0 {
            Backing::Memory(rows) => {
                Arc::try_unwrap(rows).map_err(|rows| Self(Backing::Memory(rows)))
            }
            on_disk @ Backing::Disk(_) => Err(Self(on_disk)),
        }
    }

    /// Releases the resident pages of a column on disk; they are read again on the next access.
    pub fn release(&self) {
        #[cfg(unix)]
        if let Backing::Disk(map) = &self.0 {
            // SAFETY: the map is shared and read-only, of a file without a name whose handles are
            // closed: nobody writes to it, so that its pages are read again unchanged, even while
            // others read them.
            _ = unsafe { map.unchecked_advise(memmap2::UncheckedAdvice::DontNeed) };
        }
    }
}

/// Rows of a column on disk that are read between two releases of its pages.
const PART: usize = 1 << 22;

impl<T: Pod> Column<T> {
    /// Iterates over all rows in order and releases the pages of a column on disk after each part.
    pub fn by_parts(&self) -> impl Iterator<Item = &T> {
        let part = |part| {
            self.release();
            part
        };
        self.chunks(PART).flat_map(part)
    }
}

impl<T: Pod> Deref for Column<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        match &self.0 {
            Backing::Memory(list) => list,
            Backing::Disk(map) => bytemuck::cast_slice(map),
        }
    }
}

impl<T> Default for Column<T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl<T> From<Vec<T>> for Column<T> {
    fn from(list: Vec<T>) -> Self {
        Self(Backing::Memory(Arc::new(list)))
    }
}

/// A column of any kind of number, for those who write it.
pub trait Rows: std::fmt::Debug + Send + Sync {
    /// Returns the rows as they are in memory.
    fn as_bytes(&self) -> &[u8];

    /// Releases the resident pages of a column on disk.
    fn release(&self);
}

impl<T: Pod + std::fmt::Debug + Send + Sync> Rows for Column<T> {
    fn as_bytes(&self) -> &[u8] {
        bytemuck::cast_slice(self)
    }

    fn release(&self) {
        self.release();
    }
}

impl<T> FromIterator<T> for Column<T> {
    fn from_iter<I: IntoIterator<Item = T>>(list: I) -> Self {
        Vec::from_iter(list).into()
    }
}

impl<T: Pod + std::fmt::Debug> std::fmt::Debug for Column<T> {
    fn fmt(&self, to: &mut std::fmt::Formatter) -> std::fmt::Result {
        (**self).fmt(to)
    }
}

impl<T: Pod + PartialEq> PartialEq for Column<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

/// A column under construction, append only.
pub struct ColumnBuilder<T>(BuilderBacking<T>);

enum BuilderBacking<T> {
    Memory(Vec<T>),
    Disk {
        file: File,
        folder: PathBuf,
        is_empty: bool,
    },
}

impl<T: Pod> ColumnBuilder<T> {
    pub fn new(keep: Storage) -> Result<Self, DiskError> {
        match keep {
            Storage::Memory => Ok(Self(BuilderBacking::Memory(Vec::new()))),
            Storage::Disk => Self::in_folder(&folder()),
        }
    }

    fn in_folder(folder: &Path) -> Result<Self, DiskError> {
        let file =
            tempfile::tempfile_in(folder).map_err(|source| DiskError::new(folder, source))?;
        Ok(Self(BuilderBacking::Disk {
            file,
            folder: folder.to_path_buf(),
            is_empty: true,
        }))
    }

    /// Reserves memory for `rows` more rows; does nothing on disk.
    pub fn reserve(&mut self, rows: usize) {
        if let BuilderBacking::Memory(list) = &mut self.0 {
            list.reserve_exact(rows);
        }
    }

    /// Appends rows. Pass many at once: on disk each call is a write.
    pub fn extend(&mut self, rows: &[T]) -> Result<(), DiskError> {
        match &mut self.0 {
            BuilderBacking::Memory(list) => list.extend_from_slice(rows),
            BuilderBacking::Disk {
                file,
                folder,
                is_empty,
            } => {
                // Written, not mapped: a full disk is an error here but would be a fatal signal in
                // a mapping.
                file.write_all(bytemuck::cast_slice(rows))
                    .map_err(|source| DiskError::new(folder, source))?;
                *is_empty &= rows.is_empty();
            }
        }
        Ok(())
    }

    pub fn finish(self) -> Result<Column<T>, DiskError> {
        match self.0 {
            BuilderBacking::Memory(list) => Ok(list.into()),
            // Some platforms cannot map empty files.
            BuilderBacking::Disk { is_empty: true, .. } => Ok(Column::default()),
            BuilderBacking::Disk { file, folder, .. } => {
                // Some file systems report a full disk only on sync.
                file.sync_data()
                    .map_err(|source| DiskError::new(&folder, source))?;
                // SAFETY: the file has no name, and this is its last handle, dropped here: nobody
                // writes to it or shortens it later.
                let map = unsafe { Mmap::map(&file) }
                    .map_err(|source| DiskError::new(&folder, source))?;
                Ok(Column(Backing::Disk(Arc::new(map))))
            }
        }
    }
}

/// The folder for spilled tables: not `/tmp`, which is in memory on many systems.
fn folder() -> PathBuf {
    let usual = || Some(PathBuf::from("/var/tmp")).filter(|folder| folder.is_dir());
    env::var_os("TMPDIR")
        .map(PathBuf::from)
        .or_else(usual)
        .unwrap_or_else(env::temp_dir)
}

/// Maps `work` over `items` in parallel, `at_a_time` items per batch, and passes each batch's
/// results to `take` in order. `work` gets scratch made by `start`, reused between items: some is
/// as large as the surface and takes longer to make than to use.
pub fn in_order<A: Sync, S: Send, R: Send>(
    items: &[A],
    at_a_time: usize,
    start: impl Fn() -> S + Sync + Send,
    work: impl Fn(&mut S, &A) -> Result<R, Cancelled> + Sync + Send,
    mut take: impl FnMut(&[A], Vec<R>) -> Result<(), DiskError>,
) -> Result<(), TableError> {
    let resting = Resting(Mutex::new(Vec::new()));
    let one = |item: &A| {
        let mut scratch = resting.wake().unwrap_or_else(&start);
        let done = work(&mut scratch, item);
        resting.rest(scratch);
        done
    };
    for batch in items.chunks(at_a_time) {
        take(batch, batch.par_iter().map(one).collect::<Result<_, _>>()?)?;
    }
    Ok(())
}

/// Scratch that waits for the next item.
struct Resting<S>(Mutex<Vec<S>>);

impl<S> Resting<S> {
    fn wake(&self) -> Option<S> {
        self.0.lock().ok()?.pop()
    }

    fn rest(&self, scratch: S) {
        self.0.lock().map(|mut all| all.push(scratch)).ok();
    }
}

/// Views or clusters whose rows are read between two releases of a table on disk.
pub const READ_AT_ONCE: usize = 256;

/// Maps `work` over items that read tables, in order; `release` is called after each part to free
/// the pages read.
pub fn read_by_parts<A: Sync, R: Send>(
    items: &[A],
    work: impl Fn(&A) -> R + Sync + Send,
    release: impl Fn(),
) -> Vec<R> {
    let mut results = Vec::with_capacity(items.len());
    for part in items.chunks(READ_AT_ONCE) {
        results.par_extend(part.par_iter().map(&work));
        release();
    }
    results
}

/// Error of building a table.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    #[error(transparent)]
    Disk(#[from] DiskError),
}

impl Hint for TableError {
    fn hint(&self) -> Option<Advice> {
        match self {
            Self::Cancelled(error) => error.hint(),
            Self::Disk(error) => error.hint(),
        }
    }
}

/// A table that does not fit into memory cannot be written to disk.
#[derive(Debug, thiserror::Error)]
#[error("cannot spill table to {}: {source}", folder.display())]
pub struct DiskError {
    folder: PathBuf,
    source: io::Error,
}

impl DiskError {
    fn new(folder: &Path, source: io::Error) -> Self {
        Self {
            folder: folder.to_path_buf(),
            source,
        }
    }
}

impl Hint for DiskError {
    fn hint(&self) -> Option<Advice> {
        Some(
            Advice::text("set TMPDIR to a folder on a disk with room, or allow more memory: ")
                .set("max_memory"),
        )
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_column_on_disk_holds_what_one_in_memory_holds(
            pieces in proptest::collection::vec(proptest::collection::vec(any::<u32>(), 0..3000), 0..5),
        ) {
            let of = |keep| {
                let mut column = ColumnBuilder::new(keep).unwrap();
                pieces.iter().for_each(|piece| column.extend(piece).unwrap());
                column.finish().unwrap()
            };
            let (memory, disk): (Column<u32>, Column<u32>) = (of(Storage::Memory), of(Storage::Disk));
            prop_assert_eq!(&*memory, &*pieces.concat());
            prop_assert_eq!(&memory, &disk);
            disk.release();
            prop_assert_eq!(&disk.clone(), &memory);
            prop_assert_eq!(disk.storage(), if memory.is_empty() { Storage::Memory } else { Storage::Disk });
            prop_assert_eq!((disk.bytes(), memory.bytes()), (0, 4 * memory.len()));
        }
    }

    #[test]
    fn nothing_is_left_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let mut column = ColumnBuilder::in_folder(folder.path()).unwrap();
        column.extend(&[1.5f32; 5000]).unwrap();
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
        assert_eq!(column.finish().unwrap()[4999], 1.5);
    }

    #[test]
    fn a_folder_that_takes_no_file_is_named() {
        let folder = tempfile::tempdir().unwrap().path().join("gone");
        let Err(error) = ColumnBuilder::<u32>::in_folder(&folder) else {
            panic!("there is no such folder")
        };
        assert!(
            error.to_string().contains("gone")
                && error.hint().unwrap().to_string().contains("TMPDIR"),
            "{error}"
        );
    }
}
