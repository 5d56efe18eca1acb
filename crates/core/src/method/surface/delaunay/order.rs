//! The order of insertion: along a Hilbert curve in rounds of growing size (BRIO: Amenta, Choi,
//! Rote 2003).
//!
//! Vertices are numbered along the curve, so that neighbours in space are neighbours in memory; the
//! rounds are drawn by a hash of that number, so that neither numbers nor rounds depend on the
//! order of the input.

use super::grid::{Grid, HALF_RANGE, Site};
use crate::base::progress::{Cancelled, Watcher};
use nalgebra::Point3;

/// Bits per axis of a grid coordinate once shifted to be non-negative.
const LEVELS: u32 = 30;

/// Position of a point on the Hilbert curve (90 bits), then its index (32 bits).
type Place = u128;

const INDEX_BITS: u32 = 32;
const KEY_BITS: u32 = 3 * LEVELS;
/// Bits per digit of the radix sort.
const DIGIT_BITS: u32 = 9;
/// Number of entries sorted by comparison, and between two checks for cancellation: well under 10
/// ms.
const CHUNK: usize = 1 << 15;

/// Distinct grid points along the curve, with the index of each input point among them.
pub(super) fn sorted_sites(
    points: &[Point3<f64>],
    grid: &Grid,
    watcher: &dyn Watcher,
) -> Result<(Vec<Site>, Vec<u32>), Cancelled> {
    let places = sorted_places(points, grid, watcher)?;
    let mut vertex_of_point = vec![0; points.len()];
    let mut sites: Vec<Site> = Vec::with_capacity(points.len());
    let mut last = None;
    for chunk in places.chunks(CHUNK) {
        watcher.check()?;
        for place in chunk {
            let index = *place as u32 as usize;
            if last != Some(place >> INDEX_BITS) {
                sites.push(grid.snap(&points[index]));
                last = Some(place >> INDEX_BITS);
            }
            vertex_of_point[index] = sites.len() as u32 - 1;
        }
    }
    Ok((sites, vertex_of_point))
}

fn sorted_places(
    points: &[Point3<f64>],
    grid: &Grid,
    watcher: &dyn Watcher,
) -> Result<Vec<Place>, Cancelled> {
    let mut places: Vec<Place> = Vec::with_capacity(points.len());
    for chunk in points.chunks(CHUNK) {
        watcher.check()?;
        for point in chunk {
            places.push(hilbert_key(&grid.snap(point)) << INDEX_BITS | places.len() as Place);
        }
    }
    // Radix sort: `sort_unstable` could not be cancelled.
    sort(&mut places, &mut vec![0; points.len()], KEY_BITS, watcher)?;
    Ok(places)
}

/// Radix sort of entries whose keys differ in the lowest `bits` only; small parts are sorted by
/// comparison.
fn sort(
    places: &mut [Place],
    buffer: &mut [Place],
    bits: u32,
    watcher: &dyn Watcher,
) -> Result<(), Cancelled> {
    watcher.check()?;
    if bits == 0 {
        return Ok(());
    }
    if places.len() <= CHUNK {
        places.sort_unstable();
        return Ok(());
    }
    let bits = bits - DIGIT_BITS;
    let ends = distribute(places, buffer, bits, watcher)?;
    places.copy_from_slice(buffer);
    let mut start = 0;
    for end in ends {
        sort(
            &mut places[start..end],
            &mut buffer[start..end],
            bits,
            watcher,
        )?;
        start = end;
    }
    Ok(())
}

/// Copies entries to a buffer in the order of the digit above `bits`; returns the end of each
/// digit's part.
fn distribute(
    places: &[Place],
    buffer: &mut [Place],
    bits: u32,
    watcher: &dyn Watcher,
) -> Result<[usize; 1 << DIGIT_BITS], Cancelled> {
    let digit = |place: &Place| (place >> (INDEX_BITS + bits)) as usize & ((1 << DIGIT_BITS) - 1);
    let mut ends = [0; 1 << DIGIT_BITS];
    for place in places {
        ends[digit(place)] += 1;
    }
    let mut start = 0;
    for end in &mut ends {
        (*end, start) = (start, start + *end);
    }
    for chunk in places.chunks(CHUNK) {
        watcher.check()?;
        for place in chunk {
            let end = &mut ends[digit(place)];
            buffer[*end] = *place;
            *end += 1;
        }
    }
    Ok(ends)
}

/// Returns the round of a vertex, counted from the last; each round has about eight times the
/// vertices of the one before.
pub(super) fn round_from_last(vertex: u32) -> u32 {
    mix(vertex).trailing_zeros() / 3
}

/// Returns the number of rounds for `vertices` vertices.
pub(super) fn rounds(vertices: usize) -> u32 {
    (0..vertices as u32)
        .map(round_from_last)
        .max()
        .map_or(0, |last| last + 1)
}

/// A bijective hash of 32 bits (finaliser of MurmurHash3).
fn mix(mut v: u32) -> u32 {
    v ^= v >> 16;
    v = v.wrapping_mul(0x85eb_ca6b);
    v ^= v >> 13;
    v = v.wrapping_mul(0xc2b2_ae35);
    v ^ (v >> 16)
}

/// Returns the digits of the Hilbert curve through the cube of 2^30 steps, coarsest first; equal
/// only for equal sites.
fn hilbert_key(site: &Site) -> Place {
    let [x, y, z] = site.coordinates().map(|v| (v + HALF_RANGE) as u32);
    let mut state = 0;
    // In two halves, because 90 bits do not fit into a u64.
    let mut digits = |levels: std::ops::Range<u32>| {
        levels.rev().fold(0u64, |key, level| {
            let octant = (x >> level & 1) | (y >> level & 1) << 1 | (z >> level & 1) << 2;
            let step = HILBERT[state][octant as usize];
            state = usize::from(step >> 3);
            key << 3 | u64::from(step & 7)
        })
    };
    let (high, low) = (digits(LEVELS / 2..LEVELS), digits(0..LEVELS / 2));
    Place::from(high) << (KEY_BITS / 2) | Place::from(low)
}

/// Per state (entry corner + 8 · direction) and octant: digit on the curve + 8 · next state.
static HILBERT: [[u8; 8]; 24] = hilbert_table();

/// Hamilton, Compact Hilbert Indices, 2006, section 2: the curve in terms of Gray codes.
const fn hilbert_table() -> [[u8; 8]; 24] {
    let mut table = [[0; 8]; 24];
    let mut state = 0;
    while state < 24 {
        let (entry, direction) = (state % 8, state / 8);
        let mut octant = 0;
        while octant < 8 {
            let digit = gray_inverse(rotate_right(octant ^ entry, direction + 1));
            let next_entry = entry ^ rotate_left(entry_of(digit), direction + 1);
            let next_direction = (direction + turn_of(digit) + 1) % 3;
            table[state][octant] = (digit + 8 * (next_entry + 8 * next_direction)) as u8;
            octant += 1;
        }
        state += 1;
    }
    table
}

const fn rotate_right(v: usize, by: usize) -> usize {
    let by = by % 3;
    (v >> by | v << (3 - by)) & 7
}

const fn rotate_left(v: usize, by: usize) -> usize {
    rotate_right(v, 3 - by % 3)
}

const fn gray(v: usize) -> usize {
    v ^ (v >> 1)
}

const fn gray_inverse(v: usize) -> usize {
    v ^ (v >> 1) ^ (v >> 2)
}

/// Returns the corner through which the curve enters the sub-cube of a digit.
const fn entry_of(digit: usize) -> usize {
    if digit == 0 {
        0
    } else {
        gray(2 * ((digit - 1) / 2))
    }
}

/// Returns the axis along which the curve crosses the sub-cube of a digit.
const fn turn_of(digit: usize) -> usize {
    match digit {
        0 => 0,
        d if d % 2 == 0 => (d - 1).trailing_ones() as usize % 3,
        d => d.trailing_ones() as usize % 3,
    }
}
