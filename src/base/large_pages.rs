//! Memory in huge pages: with random access to hundreds of megabytes, TLB misses cost more than the reads.

use std::collections::TryReserveError;

/// Allocates an empty list with room for `elements`, in huge pages where the system has them; the memory is not touched.
pub fn room_for<T>(elements: usize) -> Result<Vec<T>, TryReserveError> {
    let mut room = Vec::new();
    room.try_reserve_exact(elements)?;
    advise(&mut room);
    Ok(room)
}

/// Returns a list of `elements` equal elements.
pub fn filled<T: Clone>(elements: usize, with: T) -> Vec<T> {
    let mut list = room_for(elements).unwrap_or_default();
    list.resize(elements, with);
    list
}

/// Advises the system to back the list's capacity with huge pages; no effect on small lists or without system support.
#[cfg(target_os = "linux")]
fn advise<T>(room: &mut Vec<T>) {
    /// Size of a large page on most machines; smaller allocations don't use them.
    const LARGE: usize = 1 << 21;
    let (start, bytes) = (room.as_mut_ptr() as usize, room.capacity() * size_of::<T>());
    let first = start.next_multiple_of(LARGE);
    let Some(length) = (start + bytes).checked_sub(first).map(|length| length / LARGE * LARGE).filter(|l| *l > 0)
    else {
        return;
    };
    // SAFETY: the range is within the list's allocation, and the advice does not change its content. The result is ignored: it is only a hint.
    _ = unsafe { libc::madvise(first as *mut libc::c_void, length, libc::MADV_HUGEPAGE) };
}

#[cfg(not(target_os = "linux"))]
fn advise<T>(_: &mut Vec<T>) {}

#[cfg(test)]
mod tests {
    #[test]
    fn a_list_of_any_size_works_as_any_other() {
        for elements in [0usize, 1, 1000, 1 << 20] {
            let mut list = super::room_for::<u64>(elements).expect("memory");
            list.extend(0..elements as u64);
            assert!(list.capacity() >= elements && list.iter().copied().eq(0..elements as u64));
        }
        assert!(super::room_for::<u64>(usize::MAX / 16).is_err(), "an error, not the end of the program");
    }
}
