//! The cells of a fused cloud, and the maps that take part in each.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Range,
};

use nalgebra::Point3;
use rayon::prelude::*;

use super::{CloudPart, FusedPoints, Incidence, gsd::PlaceGsd, incidence::Row};
use crate::{
    apps::evaluate::{EvaluateError, clouds::cube},
    base::{kd_tree::KdTree, progress::Watcher},
    plan::Stages,
};

/// Largest number of cells of a table; of more, every second, third, ... counts. The shares of half
/// a million cells are right within a tenth of a point.
const MOST_CELLS: usize = 500_000;

/// Largest number of cells that are held while a cloud is read, which fills a hash table of 2^22
/// entries; of more, one of 2, 4, 8, ... is drawn.
const MOST_FOUND: usize = 7 << 19;

/// Maps that agree on a point of a cell that counts as sure.
const AGREEING: usize = 3;

/// Edge of a block, cubes.
const BLOCK: i64 = 4;

/// A cube: exponent of its `g_d`, and its position in multiples of its edge. Or a block, in
/// multiples of [`BLOCK`] edges.
type Cube = (i16, [i64; 3]);

/// Cells of a cloud: one for each cube with an edge of 2 `g_d` in which the cloud has a point; its
/// centre is the first of them.
pub struct CloudCells {
    centres: Vec<Point3<f64>>,
    /// Low and high corner of the centres of each size: of depths over many octaves, a place is
    /// within those of most.
    bounds: BTreeMap<i16, [Point3<f64>; 2]>,
    /// Each block's entries in `of_blocks`.
    blocks: HashMap<Cube, Range<u32>>,
    /// The cells of the cubes in a block or beside it.
    of_blocks: Vec<u32>,
}

impl CloudCells {
    /// Finds the cells of the cloud that are inside the plan's region.
    pub fn of(
        cloud: &dyn FusedPoints,
        gsd: &PlaceGsd,
        stages: &Stages,
        watcher: &dyn Watcher,
    ) -> Result<Self, EvaluateError> {
        let mut found = FoundCells::new(MOST_FOUND);
        cloud.for_each_part(&mut |part| {
            watcher.check()?;
            let octaves: Vec<Option<i16>> = part
                .points
                .par_iter()
                .map(|point| gsd.octave(point))
                .collect();
            // Not in parallel: the first point of a cube is the centre of its cell.
            for (point, octave) in part.points.iter().zip(octaves) {
                if let Some(octave) = octave {
                    found.add((octave, cube(point, edge(octave))), point);
                }
            }
            Ok(())
        })?;
        // By cell, not by point: each takes a search for the nearest triangle.
        let inside = inside(&found.centres, stages);
        Ok(Self::new(found.thinned(&inside, MOST_CELLS)))
    }

    fn new(found: FoundCells) -> Self {
        let mut bounds: BTreeMap<i16, [Point3<f64>; 2]> = BTreeMap::new();
        let mut pairs: Vec<(Cube, u32)> = Vec::new();
        for (&(octave, position), &cell) in &found.cells {
            let centre = found.centres[cell as usize];
            let [low, high] = bounds.entry(octave).or_insert([centre; 2]);
            (*low, *high) = (low.inf(&centre), high.sup(&centre));
            let blocks = blocks_around(position);
            pairs.extend(blocks.map(|block| ((octave, block), cell)));
        }
        // The hash table's order differs from run to run.
        pairs.sort_unstable();
        let mut blocks: HashMap<Cube, Range<u32>> = HashMap::new();
        for (at, &(block, _)) in (0..).zip(&pairs) {
            blocks.entry(block).or_insert(at..at).end = at + 1;
        }
        Self {
            centres: found.centres,
            bounds,
            blocks,
            of_blocks: pairs.into_iter().map(|(_, cell)| cell).collect(),
        }
    }

    /// Returns which of the maps take part in which cells: those that agree on a point within
    /// 2 `g_d` of the centre.
    pub fn incidence(
        &self,
        cloud: &dyn FusedPoints,
        names: Vec<String>,
        support: u32,
        watcher: &dyn Watcher,
    ) -> Result<Incidence, EvaluateError> {
        let words = names.len().div_ceil(64);
        let mut maps = vec![0u64; words * self.centres.len()];
        let mut agreeing = vec![false; self.centres.len()];
        cloud.for_each_part(&mut |part: &CloudPart| {
            watcher.check()?;
            for (point, of_point) in part.iter() {
                self.near(point, |cell| {
                    let row = &mut maps[words * cell..words * (cell + 1)];
                    of_point
                        .iter()
                        .for_each(|&map| row[map as usize / 64] |= 1 << (map % 64));
                    agreeing[cell] |= of_point.len() >= AGREEING;
                });
            }
            Ok(())
        })?;
        // Sorted, so that the file of the table is the same each time.
        let mut rows: BTreeMap<&[u64], [u32; 2]> = BTreeMap::new();
        // Without maps, rows have no words, and chunks of 0 would panic.
        for (row, &agreeing) in maps.chunks_exact(words.max(1)).zip(&agreeing) {
            let counts = rows.entry(row).or_default();
            counts[0] += 1;
            counts[1] += u32::from(agreeing);
        }
        let row = |(maps, [cells, agreeing]): (&[u64], [u32; 2])| Row {
            maps: (0..names.len() as u32)
                .filter(|&map| maps[map as usize / 64] >> (map % 64) & 1 == 1)
                .collect(),
            cells,
            agreeing,
        };
        let rows = rows.into_iter().map(row).collect();
        Ok(Incidence::new(names, rows, support))
    }

    /// Calls `take` with each cell whose centre is within its 2 `g_d` of the point.
    fn near(&self, point: &Point3<f64>, mut take: impl FnMut(usize)) {
        for (edge, cells) in self.cells_around(point) {
            let cells = cells.iter().map(|&cell| cell as usize);
            cells
                .filter(|&cell| (self.centres[cell] - point).norm() <= edge)
                .for_each(&mut take);
        }
    }

    /// Returns the cells whose centres may be so near, and that distance, for each size.
    fn cells_around(&self, point: &Point3<f64>) -> impl Iterator<Item = (f64, &[u32])> {
        self.bounds
            .iter()
            .filter_map(move |(&octave, [low, high])| {
                let edge = edge(octave);
                let is_outside = (low - point).max() > edge || (point - high).max() > edge;
                let block = (!is_outside).then(|| block(cube(point, edge)))?;
                let cells = self.blocks.get(&(octave, block))?;
                Some((
                    edge,
                    &self.of_blocks[cells.start as usize..cells.end as usize],
                ))
            })
    }
}

/// The cells of a cloud while it is read.
struct FoundCells {
    centres: Vec<Point3<f64>>,
    /// Index of the cell of each cube.
    cells: HashMap<Cube, u32>,
    /// Cells that are held.
    most: usize,
    /// Number of times that half of the cubes were left out.
    halvings: u32,
}

impl FoundCells {
    fn new(most: usize) -> Self {
        Self {
            centres: Vec::new(),
            cells: HashMap::new(),
            most,
            halvings: 0,
        }
    }

    fn add(&mut self, cube: Cube, point: &Point3<f64>) {
        if !is_drawn(&cube, self.halvings) {
            return;
        }
        let new = self.centres.len() as u32;
        if *self.cells.entry(cube).or_insert(new) == new {
            self.centres.push(*point);
        }
        // One more would double the table.
        if self.centres.len() == self.most {
            self.halve();
        }
    }

    fn halve(&mut self) {
        self.halvings += 1;
        let mut is_kept = vec![false; self.centres.len()];
        for (cube, &cell) in &self.cells {
            is_kept[cell as usize] = is_drawn(cube, self.halvings);
        }
        self.keep(&is_kept);
    }

    /// Keeps those `inside`, at most about `most` of them.
    fn thinned(mut self, inside: &[bool], most: usize) -> Self {
        let number = inside.iter().filter(|&&inside| inside).count();
        let step = number.div_ceil(most).max(1);
        let mut kept = vec![false; self.centres.len()];
        let all = (0..self.centres.len()).filter(|&cell| inside[cell]);
        all.step_by(step).for_each(|cell| kept[cell] = true);
        self.keep(&kept);
        self.cells.shrink_to_fit();
        self.centres.shrink_to_fit();
        self
    }

    /// Keeps some cells, in their order.
    fn keep(&mut self, is_kept: &[bool]) {
        let mut next = 0..;
        let new: Vec<Option<u32>> = is_kept
            .iter()
            .map(|&is_kept| if is_kept { next.next() } else { None })
            .collect();
        self.cells.retain(|_, cell| {
            let new = new[*cell as usize];
            *cell = new.unwrap_or_default();
            new.is_some()
        });
        let mut is_kept = is_kept.iter();
        self.centres
            .retain(|_| *is_kept.next().expect("a flag for each cell"));
    }
}

/// Returns whether a cube is one of the 2^-`halvings` of all that are drawn.
fn is_drawn((octave, position): &Cube, halvings: u32) -> bool {
    // An odd factor with as many ones as zeros, which spreads each bit over those above it.
    let mix = |mixed: u64, part: i64| {
        let product = (mixed ^ part as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        product ^ product >> 32
    };
    let mixed = position.iter().copied().fold(mix(0, (*octave).into()), mix);
    mixed.leading_zeros() >= halvings
}

/// Edge of a cube: 2 `g_d`.
fn edge(octave: i16) -> f64 {
    2.0 * f64::from(octave).exp2()
}

/// The block of a cube.
fn block(cube: [i64; 3]) -> [i64; 3] {
    cube.map(|position| position.div_euclid(BLOCK))
}

/// Returns the blocks in which a cube or a neighbour of it is.
fn blocks_around(position: [i64; 3]) -> impl Iterator<Item = [i64; 3]> {
    // Positions of far points saturate at the ends of i64.
    let ends = position
        .map(|position| [-1, 1].map(|step| position.saturating_add(step).div_euclid(BLOCK)));
    let blocks = |axis: usize| ends[axis][0]..=ends[axis][1];
    let [x, y, z] = [0, 1, 2].map(blocks);
    x.flat_map(move |x| {
        let z = z.clone();
        y.clone()
            .flat_map(move |y| z.clone().map(move |z| [x, y, z]))
    })
}

/// Returns which places are inside the plan's region, as the triangle nearest to each is.
fn inside(places: &[Point3<f64>], stages: &Stages) -> Vec<bool> {
    let Some(region) = &stages.region else {
        return vec![true; places.len()];
    };
    let surface = &stages.surface;
    let centroids: Vec<Point3<f64>> = (0..surface.triangles.len() as u32)
        .map(|t| surface.centroid(t))
        .collect();
    let tree = KdTree::new(&centroids);
    let inside = |place: &Point3<f64>| region.is_inside(tree.nearest::<1>(place)[0]);
    places.par_iter().map(inside).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    /// Points at depths over thirty octaves, each in a cell of the octave of its depth.
    fn cone(points: usize) -> Vec<(i16, Point3<f64>)> {
        let point = |n: usize| {
            // Steps of these shares fill a cube evenly.
            let [x, y, z] =
                [0.8191725, 0.6710436, 0.5497004].map(|step: f64| (n as f64 * step).fract());
            let depth = (30.0 * z).exp2();
            let point = Point3::new(depth * (x - 0.5), depth * (y - 0.5), depth);
            (depth.log2().round() as i16 - 8, point)
        };
        (0..points).map(point).collect()
    }

    fn found(points: &[(i16, Point3<f64>)], most: usize) -> FoundCells {
        let mut found = FoundCells::new(most);
        for (octave, point) in points {
            found.add((*octave, cube(point, edge(*octave))), point);
        }
        found
    }

    #[test]
    fn cells_near_a_point_are_those_of_a_search_through_all() {
        let points = cone(2000);
        let cells = found(&points, MOST_FOUND).cells;
        let table = CloudCells::new(found(&points, MOST_FOUND));
        let mut number = 0;
        for (n, &(octave, point)) in points.iter().enumerate() {
            let point = point
                + nalgebra::Vector3::new(1.0, -0.5, 0.7) * edge(octave) * (n % 3) as f64 / 2.0;
            let mut near = Vec::new();
            table.near(&point, |cell| near.push(cell));
            near.sort_unstable();
            let within = |(&(octave, _), &cell): (&Cube, &u32)| {
                ((table.centres[cell as usize] - point).norm() <= edge(octave))
                    .then_some(cell as usize)
            };
            let mut all: Vec<usize> = cells.iter().filter_map(within).collect();
            all.sort_unstable();
            assert_eq!(near, all);
            number += all.len();
        }
        assert!(number > points.len() / 3);
    }

    #[test]
    fn depths_over_many_octaves_cost_no_more_than_those_of_one() {
        let points = cone(20_000);
        let table = CloudCells::new(found(&points, MOST_FOUND));
        assert!(table.bounds.len() > 25);
        let looked_at = |(_, point): &(i16, Point3<f64>)| -> usize {
            let cells = table.cells_around(point);
            cells.map(|(_, cells)| cells.len()).sum()
        };
        let looked_at: usize = points.iter().map(looked_at).sum();
        assert!(looked_at < 8 * points.len(), "{looked_at}");
    }

    #[test]
    fn of_too_many_cells_half_are_drawn_again_and_again() {
        let points = cone(20_000);
        let all = found(&points, MOST_FOUND);
        let drawn = found(&points, 3000);
        assert_eq!(drawn.centres.len(), drawn.cells.len());
        assert!((1000..=3000).contains(&drawn.centres.len()));
        // The others are as they would be, in their order.
        let place = |cube: &Cube| all.cells[cube];
        let mut cubes: Vec<&Cube> = drawn.cells.keys().collect();
        cubes.sort_by_key(|cube| place(cube));
        for (cell, cube) in (0..).zip(cubes) {
            assert_eq!(drawn.cells[cube], cell);
            let centre = all.centres[place(cube) as usize];
            assert_eq!(drawn.centres[cell as usize], centre);
        }
    }

    #[test]
    fn half_of_the_cubes_of_a_plane_are_drawn() {
        let plane = (0..10_000).map(|i| (-3, [i % 100, i / 100 - 50, 7]));
        let cubes: Vec<Cube> = plane.collect();
        for halvings in 0..5 {
            let drawn = cubes.iter().filter(|cube| is_drawn(cube, halvings)).count();
            let share = drawn as f64 / cubes.len() as f64;
            let expected = 0.5_f64.powi(halvings as i32);
            assert!((share / expected - 1.0).abs() < 0.2, "{halvings}: {share}");
        }
    }
}
