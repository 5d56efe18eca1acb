//! The cells of a fused cloud, and the maps that take part in each.

use std::collections::{BTreeMap, HashMap, HashSet};

use nalgebra::Point3;
use rayon::prelude::*;

use super::{CloudPart, FusedPoints, Incidence, gsd::PlaceGsd, incidence::Row};
use crate::{
    apps::evaluate::EvaluateError,
    base::{kd_tree::KdTree, progress::Watcher},
    plan::Stages,
};

/// Largest number of cells of a table; of more, every second, third, ... counts. The shares of half
/// a million cells are right within a tenth of a point.
const MOST_CELLS: usize = 500_000;

/// Maps that agree on a point of a cell that counts as sure.
const AGREEING: usize = 3;

/// Edge of a block, cubes.
const BLOCK: i64 = 4;

/// A cube: exponent of its `g_d`, and its position in multiples of its edge.
type Cube = (i16, [i64; 3]);

/// Cells of a cloud: one for each cube with an edge of 2 `g_d` in which the cloud has a point; its
/// centre is the first of them.
pub struct CloudCells {
    centres: Vec<Point3<f64>>,
    /// Index of the cell of each cube.
    cells: HashMap<Cube, u32>,
    /// The cubes by their size.
    octaves: BTreeMap<i16, Octave>,
}

/// The cubes of a size: of depths over many octaves, a place is within the bounds of most.
struct Octave {
    /// Low and high corner of the centres.
    bounds: [Point3<f64>; 2],
    /// The blocks of 4 x 4 x 4 cubes in which a cube or a neighbour of one is.
    blocks: HashSet<[i64; 3]>,
}

impl CloudCells {
    /// Finds the cells of the cloud that are inside the plan's region.
    pub fn of(
        cloud: &dyn FusedPoints,
        gsd: &PlaceGsd,
        stages: &Stages,
        watcher: &dyn Watcher,
    ) -> Result<Self, EvaluateError> {
        let mut cubes: HashMap<Cube, u32> = HashMap::new();
        let mut centres = Vec::new();
        cloud.for_each_part(&mut |part| {
            watcher.check()?;
            let octaves: Vec<Option<i16>> = part
                .points
                .par_iter()
                .map(|point| gsd.octave(point))
                .collect();
            for (point, octave) in part.points.iter().zip(octaves) {
                let Some(octave) = octave else { continue };
                cubes
                    .entry((octave, cube(point, octave)))
                    .or_insert_with(|| {
                        centres.push(*point);
                        centres.len() as u32 - 1
                    });
            }
            Ok(())
        })?;
        let inside = inside(&centres, stages);
        let number = inside.iter().filter(|&&inside| inside).count();
        let step = number.div_ceil(MOST_CELLS).max(1);
        let mut new = vec![None; centres.len()];
        let kept = (0..centres.len())
            .filter(|&cell| inside[cell])
            .step_by(step);
        let kept: Vec<usize> = kept.collect();
        (0..)
            .zip(&kept)
            .for_each(|(index, &cell)| new[cell] = Some(index));
        let cells: HashMap<Cube, u32> = cubes
            .into_iter()
            .filter_map(|(cube, cell)| Some((cube, new[cell as usize]?)))
            .collect();
        let centres: Vec<Point3<f64>> = kept.iter().map(|&cell| centres[cell]).collect();
        Ok(Self::new(centres, cells))
    }

    fn new(centres: Vec<Point3<f64>>, cells: HashMap<Cube, u32>) -> Self {
        let mut octaves: BTreeMap<i16, Octave> = BTreeMap::new();
        for (&(octave, position), &cell) in &cells {
            let centre = centres[cell as usize];
            let of_size = octaves.entry(octave).or_insert_with(|| Octave {
                bounds: [centre; 2],
                blocks: HashSet::new(),
            });
            let [low, high] = &mut of_size.bounds;
            (*low, *high) = (low.inf(&centre), high.sup(&centre));
            for corner in 0..8 {
                let neighbour = [0, 1, 2].map(|axis| {
                    let step = if corner >> axis & 1 == 1 { 1 } else { -1 };
                    position[axis].saturating_add(step)
                });
                of_size.blocks.insert(block(neighbour));
            }
        }
        Self {
            centres,
            cells,
            octaves,
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
        let mut rows: BTreeMap<&[u64], [u32; 2]> = BTreeMap::new();
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
        for cube in self.cubes_around(point) {
            if let Some(&cell) = self.cells.get(&cube)
                && (self.centres[cell as usize] - point).norm() <= edge(cube.0)
            {
                take(cell as usize);
            }
        }
    }

    /// Returns the cubes, of a cell or not, in which a centre so near may be.
    fn cubes_around(&self, point: &Point3<f64>) -> impl Iterator<Item = Cube> {
        self.octaves
            .iter()
            .filter_map(move |(&octave, of_size)| {
                let (middle, edge) = (cube(point, octave), edge(octave));
                let [low, high] = &of_size.bounds;
                let is_outside = (low - point).max() > edge || (point - high).max() > edge;
                (!is_outside && of_size.blocks.contains(&block(middle))).then_some((octave, middle))
            })
            .flat_map(|(octave, middle)| {
                let offsets = (0..27).map(|i| [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1]);
                offsets.map(move |offset| {
                    let position = [0, 1, 2].map(|axis| middle[axis].saturating_add(offset[axis]));
                    (octave, position)
                })
            })
    }
}

/// Edge of a cube: 2 `g_d`.
fn edge(octave: i16) -> f64 {
    2.0 * f64::from(octave).exp2()
}

fn cube(point: &Point3<f64>, octave: i16) -> [i64; 3] {
    let edge = edge(octave);
    [0, 1, 2].map(|axis| (point[axis] / edge).floor() as i64)
}

/// The block of a cube.
fn block(cube: [i64; 3]) -> [i64; 3] {
    cube.map(|position| position.div_euclid(BLOCK))
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

    fn cells(points: &[(i16, Point3<f64>)]) -> CloudCells {
        let mut cells = HashMap::new();
        let mut centres = Vec::new();
        for &(octave, point) in points {
            cells
                .entry((octave, cube(&point, octave)))
                .or_insert_with(|| {
                    centres.push(point);
                    centres.len() as u32 - 1
                });
        }
        CloudCells::new(centres, cells)
    }

    #[test]
    fn cells_near_a_point_are_those_of_a_search_through_all() {
        let points = cone(2000);
        let table = cells(&points);
        let mut found = 0;
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
            let mut all: Vec<usize> = table.cells.iter().filter_map(within).collect();
            all.sort_unstable();
            assert_eq!(near, all);
            found += all.len();
        }
        assert!(found > points.len() / 3);
    }

    #[test]
    fn depths_over_many_octaves_cost_no_more_than_those_of_one() {
        let points = cone(20_000);
        let table = cells(&points);
        assert!(table.octaves.len() > 25);
        let looked_at: usize = points
            .iter()
            .map(|(_, point)| table.cubes_around(point).count())
            .sum();
        assert!(looked_at < 2 * 27 * points.len(), "{looked_at}");
    }
}
