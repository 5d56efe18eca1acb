//! Sets of numbers as bits of words.

/// Returns the places of the bits that are set, ascending, and clears them. `capacity`: their
/// number, as far as it is known.
pub fn take(words: &mut [u64], capacity: usize) -> Vec<u32> {
    let mut places = Vec::with_capacity(capacity);
    for (i, word) in (0..).zip(words) {
        let mut rest = std::mem::take(word);
        while rest != 0 {
            places.push(64 * i + rest.trailing_zeros());
            rest &= rest - 1;
        }
    }
    places
}

#[cfg(test)]
mod tests {
    #[test]
    fn bits_are_taken_in_their_order_and_only_once() {
        let set = [0u32, 1, 63, 64, 130, 191];
        let mut words = vec![0u64; 3];
        set.iter()
            .for_each(|&place| words[place as usize / 64] |= 1 << (place % 64));
        assert_eq!(super::take(&mut words, set.len()), set);
        assert_eq!((super::take(&mut words, 0), words), (vec![], vec![0; 3]));
    }
}
