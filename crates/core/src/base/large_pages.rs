//! Memory in huge pages: with random access to hundreds of megabytes, TLB misses cost more than the
//! reads.

use std::io;

use bytemuck::{Zeroable, allocation};

/// Returns an empty list with room for `elements`, in huge pages where the system has them. The
/// memory is not touched.
pub fn room_for<T>(elements: usize) -> Vec<T> {
    let mut room = Vec::with_capacity(elements);
    advise(&mut room);
    room
}

/// Allocates `elements` zeros, in huge pages as [`room_for`] does. Pages are faulted in by the
/// threads that first write to them.
pub fn zeroed<T: Zeroable>(elements: usize) -> Vec<T> {
    let mut list = allocation::zeroed_vec(elements);
    advise(&mut list);
    list
}

/// Like [`zeroed`], but returns an error if the allocation fails.
pub fn try_zeroed<T: Zeroable>(elements: usize) -> io::Result<Vec<T>> {
    let mut list = allocation::try_zeroed_vec(elements).map_err(|()| io::ErrorKind::OutOfMemory)?;
    advise(&mut list);
    Ok(list)
}

/// Advises the system to back the list's capacity with huge pages; no effect on small lists or
/// without system support.
#[cfg(target_os = "linux")]
fn advise<T>(room: &mut Vec<T>) {
    /// Size of a large page on most machines; smaller allocations don't use them.
    const LARGE: usize = 1 << 21;
    let (start, bytes) = (room.as_mut_ptr() as usize, room.capacity() * size_of::<T>());
    let first = start.next_multiple_of(LARGE);
    let Some(length) = (start + bytes)
        .checked_sub(first)
        .map(|length| length / LARGE * LARGE)
        .filter(|l| *l > 0)
    else {
        return;
    };
    // SAFETY: the range is within the list's allocation, which is borrowed mutably, and the advice
    // does not change its content. The result is ignored: it is only a hint.
    _ = unsafe { libc::madvise(first as *mut libc::c_void, length, libc::MADV_HUGEPAGE) };
}

#[cfg(not(target_os = "linux"))]
fn advise<T>(_: &mut Vec<T>) {}

/// Returns memory that was freed to the system where the allocator keeps it: glibc holds on to
/// hundreds of megabytes after a stage that many threads worked on, which the next large table then
/// comes on top of.
pub fn return_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it takes a number, may be called from any thread, and returns pages of free blocks
    // alone.
    unsafe {
        libc::malloc_trim(0);
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_list_of_any_size_works_as_any_other() {
        for elements in [0usize, 1, 1000, 1 << 20] {
            let lists = [
                super::zeroed::<u64>(elements),
                super::try_zeroed(elements).expect("memory"),
            ];
            assert_eq!(lists, [vec![0; elements], vec![0; elements]]);
            let mut list = super::room_for::<u64>(elements);
            list.extend(0..elements as u64);
            assert!(list.capacity() >= elements && list.iter().copied().eq(0..elements as u64));
        }
        assert!(
            super::try_zeroed::<u64>(usize::MAX / 16).is_err(),
            "an error, not the end of the program"
        );
    }
}
