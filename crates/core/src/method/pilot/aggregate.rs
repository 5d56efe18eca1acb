//! Aggregation of matching costs along eight paths (semi-global matching, Hirschmüller 2008).

use crate::base::vector::{Kernel, vectorised};

/// Penalty of a step to the next plane.
const NEXT: u8 = 5;
/// Penalty of a larger step.
const FAR: u8 = 32;
/// More than any cost of a path, which is at most that of a pixel and [`FAR`]; with [`NEXT`] added
/// it still fits into eight bits.
const NEVER: u8 = 120;
/// Paths of a pass that come from the row before.
const FROM_ABOVE: usize = 3;

/// Aggregates the costs of one picture after another in the same buffers.
#[derive(Default)]
pub struct Aggregation {
    /// Costs of the path along the row, at the pixel before and at this one, with [`NEVER`] before
    /// the first plane and after the last.
    along: [Vec<u8>; 2],
    /// The same of the other paths, at the pixels of the row before and of this one.
    above: [Vec<u8>; 2],
    /// Least cost of the latter.
    least: [Vec<u8>; 2],
    /// Costs before the first pixel of a path: zeros.
    start: Vec<u8>,
    /// Sum over all paths, by pixel and plane.
    pub sums: Vec<u16>,
}

/// Costs by row, column and plane.
#[derive(Clone, Copy)]
pub struct Volume<'a> {
    pub costs: &'a [u8],
    pub width: usize,
    pub height: usize,
    pub planes: usize,
}

impl Aggregation {
    /// Adds up the costs, at most 64 each, along eight paths that begin at the border.
    pub fn run(&mut self, volume: Volume) {
        vectorised(Passes {
            volume,
            buffers: self,
        });
    }
}

struct Passes<'a> {
    volume: Volume<'a>,
    buffers: &'a mut Aggregation,
}

impl Kernel for Passes<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { volume, buffers } = self;
        let height = volume.height;
        buffers.begin(&volume);
        // From the first pixel to the last, and back.
        for is_back in [false, true] {
            for n in 0..height {
                let y = if is_back { height - 1 - n } else { n };
                buffers.above.swap(0, 1);
                buffers.least.swap(0, 1);
                buffers.add_row(&volume, y, is_back, n == 0);
            }
        }
    }
}

impl Aggregation {
    fn begin(&mut self, volume: &Volume) {
        let stride = volume.planes + 2;
        self.sums.clear();
        self.sums.resize(volume.costs.len(), 0);
        self.start.clear();
        self.start.resize(stride, 0);
        for along in &mut self.along {
            along.clear();
            // The borders spare a test at the first and the last plane.
            along.resize(stride, NEVER);
        }
        for (above, least) in self.above.iter_mut().zip(&mut self.least) {
            above.clear();
            above.resize(FROM_ABOVE * volume.width * stride, NEVER);
            least.clear();
            least.resize(FROM_ABOVE * volume.width, 0);
        }
    }

    /// Adds the paths of a pass at the pixels of a row. `is_first`: there is no row before it.
    #[inline(always)]
    fn add_row(&mut self, volume: &Volume, y: usize, is_back: bool, is_first: bool) {
        let (width, planes) = (volume.width, volume.planes);
        let mut least_along = 0;
        for i in 0..width {
            let x = if is_back { width - 1 - i } else { i };
            let at = (y * width + x) * planes;
            let own = &volume.costs[at..at + planes];
            let sums = &mut self.sums[at..at + planes];
            self.along.swap(0, 1);
            let [before, here] = &mut self.along;
            least_along = match i {
                0 => step(own, &self.start, here, sums, 0),
                _ => step(own, before, here, sums, least_along),
            };
            self.add_from_above(own, at, x, is_first);
        }
    }

    /// Adds the paths from the row before at a pixel with these costs.
    #[inline(always)]
    fn add_from_above(&mut self, own: &[u8], at: usize, x: usize, is_first: bool) {
        let (planes, stride) = (own.len(), own.len() + 2);
        let sums = &mut self.sums[at..at + planes];
        let [above, here] = &mut self.above;
        let [least_above, least] = &mut self.least;
        let width = least.len() / FROM_ABOVE;
        // The pixels of the row before: behind, beside and ahead.
        for (path, column) in [x.wrapping_sub(1), x, x + 1].into_iter().enumerate() {
            let to = path * width + x;
            let out = &mut here[to * stride..(to + 1) * stride];
            least[to] = if is_first || column >= width {
                step(own, &self.start, out, sums, 0)
            } else {
                let from = path * width + column;
                let before = &above[from * stride..(from + 1) * stride];
                step(own, before, out, sums, least_above[from])
            };
        }
    }
}

/// Continues a path at a pixel: `out[d] = costs[d] + min(before[d], before[d - 1] + NEXT, before[d
/// + 1] + NEXT, least + FAR) - least`, added to `sums`. Returns the least of `out`.
#[inline(always)]
fn step(costs: &[u8], before: &[u8], out: &mut [u8], sums: &mut [u16], least: u8) -> u8 {
    let planes = costs.len();
    let (fewer, same, more) = (
        &before[..planes],
        &before[1..=planes],
        &before[2..planes + 2],
    );
    let (out, sums) = (&mut out[1..=planes], &mut sums[..planes]);
    let most = least + FAR;
    let mut best = u8::MAX;
    // Nothing wraps: a pixel costs at most 64, a path at most that and FAR.
    for d in 0..planes {
        let beside = fewer[d].wrapping_add(NEXT).min(more[d].wrapping_add(NEXT));
        let cost = costs[d].wrapping_add(same[d].min(beside).min(most).wrapping_sub(least));
        out[d] = cost;
        best = best.min(cost);
        sums[d] = sums[d].wrapping_add(u16::from(cost));
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By the definition, path by path.
    fn by_definition(volume: Volume) -> Vec<u16> {
        let Volume {
            costs,
            width,
            height,
            planes,
        } = volume;
        let mut sums = vec![0; costs.len()];
        let directions = [
            (-1, 0),
            (-1, -1),
            (0, -1),
            (1, -1),
            (1, 0),
            (1, 1),
            (0, 1),
            (-1, 1),
        ];
        for (dx, dy) in directions {
            let mut path = vec![[0i32; 8]; width * height];
            let mut rows: Vec<i32> = (0..height as i32).collect();
            let mut columns: Vec<i32> = (0..width as i32).collect();
            if dy > 0 || dy == 0 && dx > 0 {
                rows.reverse();
                columns.reverse();
            }
            for &y in &rows {
                for &x in &columns {
                    let (px, py) = (x + dx, y + dy);
                    let inside =
                        (0..width as i32).contains(&px) && (0..height as i32).contains(&py);
                    let before = inside.then(|| path[py as usize * width + px as usize]);
                    let pixel = y as usize * width + x as usize;
                    for d in 0..planes {
                        let own = i32::from(costs[pixel * planes + d]);
                        let from = before.map_or(0, |before| {
                            let least = *before[..planes].iter().min().unwrap();
                            let cost = |(other, &cost): (usize, &i32)| {
                                cost + match other.abs_diff(d) {
                                    0 => 0,
                                    1 => i32::from(NEXT),
                                    _ => i32::from(FAR),
                                }
                            };
                            before[..planes].iter().enumerate().map(cost).min().unwrap() - least
                        });
                        path[pixel][d] = own + from;
                        sums[pixel * planes + d] += (own + from) as u16;
                    }
                }
            }
        }
        sums
    }

    #[test]
    fn paths_are_those_of_the_definition() {
        let (width, height, planes) = (7, 5, 6);
        let costs: Vec<u8> = (0..width * height * planes)
            .map(|i| (i * i * 31 % 65) as u8)
            .collect();
        let volume = Volume {
            costs: &costs,
            width,
            height,
            planes,
        };
        let mut aggregation = Aggregation::default();
        // The buffers of an earlier picture change nothing.
        aggregation.run(Volume {
            costs: &costs[..60],
            width: 5,
            height: 3,
            planes: 4,
        });
        aggregation.run(volume);
        assert_eq!(aggregation.sums, by_definition(volume));
    }
}
