//! The cells of a fused cloud, and the maps that take part in each.

use std::collections::{BTreeMap, HashMap};

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

/// A cube: exponent of its `g_d`, and its position in multiples of its edge.
type Cube = (i16, [i64; 3]);

/// Cells of a cloud: one for each cube with an edge of 2 `g_d` in which the cloud has a point; its
/// centre is the first of them.
pub struct CloudCells {
    centres: Vec<Point3<f64>>,
    /// Index of the cell of each cube.
    cells: HashMap<Cube, u32>,
    /// Bounds of the centres of each size of cube.
    octaves: BTreeMap<i16, Bounds>,
}

/// Low and high corner.
type Bounds = [Point3<f64>; 2];

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
        let mut octaves: BTreeMap<i16, Bounds> = BTreeMap::new();
        for (&(octave, _), &cell) in &cells {
            let centre = centres[cell as usize];
            let [low, high] = octaves.entry(octave).or_insert([centre; 2]);
            (*low, *high) = (low.inf(&centre), high.sup(&centre));
        }
        Ok(Self {
            centres,
            cells,
            octaves,
        })
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
        for (&octave, [low, high]) in &self.octaves {
            let (middle, edge) = (cube(point, octave), edge(octave));
            if (low - point).max() > edge || (point - high).max() > edge {
                continue;
            }
            for offset in (0..27).map(|i| [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1]) {
                let position = [0, 1, 2].map(|axis| middle[axis].saturating_add(offset[axis]));
                if let Some(&cell) = self.cells.get(&(octave, position))
                    && (self.centres[cell as usize] - point).norm() <= edge
                {
                    take(cell as usize);
                }
            }
        }
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
