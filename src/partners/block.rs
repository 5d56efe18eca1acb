//! What a partner search of one key view computes with: its judging triangles and, for each candidate, what it contributes there.
//!
//! Structure of arrays in f32, gathered once per key view, so that judging a set of partners runs over contiguous memory and
//! vectorises. The sums judge sets against each other; what is kept in the end is computed anew in f64 by [`crate::fulfilment`].

use crate::{
    fulfilment::{Eye, Model},
    scene::ViewIndex,
};

/// Newton steps for the smallest eigenvalue: enough to tell sets apart.
const STEPS: usize = 4;

/// A column an entry of the information matrix: xx, xy, xz, yy, yz, zz.
type Columns = [Vec<f32>; 6];

/// The data of one key view.
pub struct Block {
    /// α f_res of each triangle.
    resolution: Vec<f32>,
    uncertainty_weight: f32,
    min_cameras: f32,
    /// `None`: success is certain.
    min_matches: Option<u32>,
    key: Columns,
    candidates: Vec<Candidate>,
}

/// What one candidate contributes, triangle by triangle.
struct Candidate {
    information: Columns,
    /// 1 where it sees the triangle, else 0.
    sees: Vec<f32>,
    /// p_i, 0 where it doesn't.
    probability: Vec<f32>,
}

impl Block {
    /// Gathers the rows `judging` (ascending positions in the key view's visible triangles) for all candidates.
    pub fn gather(model: &Model, key: ViewIndex, candidates: &[ViewIndex], judging: &[u32]) -> Self {
        let (visible, first_row) = (model.visibility.of(key), model.visibility.rows(key).start);
        let eye = Eye::new(model, key);
        let looks = judging.iter().filter_map(|&i| {
            let triangle = visible[i as usize];
            eye.look(triangle, first_row + i as usize).map(|look| (triangle, look))
        });
        let looks: Vec<_> = looks.collect();
        let resolution = looks.iter().map(|(t, _)| (model.rule.alpha * eye.resolution(*t)) as f32).collect();
        let mut key_columns = columns(looks.len());
        for (i, (_, look)) in looks.iter().enumerate() {
            set(&mut key_columns, i, &look.information.0);
        }
        let gathered = candidates.iter().map(|&candidate| {
            let (triangles, first_row) = (model.visibility.of(candidate), model.visibility.rows(candidate).start);
            let eye = Eye::new(model, candidate);
            let mut data = Candidate::unseen(looks.len());
            let mut from = 0;
            for (i, (triangle, key_look)) in looks.iter().enumerate() {
                from += triangles[from..].partition_point(|t| t < triangle);
                if triangles.get(from) != Some(triangle) {
                    continue;
                }
                if let Some(look) = eye.look(*triangle, first_row + from) {
                    set(&mut data.information, i, &look.information.0);
                    data.sees[i] = 1.0;
                    data.probability[i] = model.rule.confidence.pair(key_look, &look) as f32;
                }
            }
            data
        });
        Self {
            resolution,
            uncertainty_weight: (1.0 - model.rule.alpha) as f32,
            min_cameras: model.rule.min_cameras as f32,
            min_matches: model.rule.confidence.min_matches(),
            key: key_columns,
            candidates: gathered.collect(),
        }
    }

    pub fn candidates(&self) -> usize {
        self.candidates.len()
    }

    /// A set of no partners.
    pub fn empty_set(&self) -> PartnerSet {
        let triangles = self.resolution.len();
        let mut fewer: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; triangles]);
        fewer[0].fill(1.0);
        PartnerSet { information: self.key.clone(), cameras: vec![1.0; triangles], fewer }
    }

    /// A set of these candidates.
    pub fn set_of(&self, members: &[u8]) -> PartnerSet {
        let mut set = self.empty_set();
        members.iter().for_each(|&member| set.add(&self.candidates[usize::from(member)]));
        set
    }

    /// Puts one more candidate into the set.
    pub fn add(&self, set: &mut PartnerSet, candidate: u8) {
        set.add(&self.candidates[usize::from(candidate)]);
    }

    /// Σ f over the judging triangles if `candidate` joined the set; in f64, in the order of triangles.
    pub fn sum_with(&self, set: &PartnerSet, candidate: u8) -> f64 {
        let candidate = &self.candidates[usize::from(candidate)];
        match self.min_matches {
            None => self.sum::<0>(set, candidate),
            Some(1) => self.sum::<1>(set, candidate),
            Some(2) => self.sum::<2>(set, candidate),
            Some(_) => self.sum::<3>(set, candidate),
        }
    }

    /// `FEWER`: how many of the entries of [`PartnerSet::fewer`] count as failure.
    fn sum<const FEWER: usize>(&self, set: &PartnerSet, candidate: &Candidate) -> f64 {
        let mut values = [0f32; CHUNK];
        let mut sum = 0.0;
        for start in (0..self.resolution.len()).step_by(CHUNK) {
            let length = CHUNK.min(self.resolution.len() - start);
            self.values::<FEWER>(set, candidate, start, &mut values[..length]);
            sum += values[..length].iter().map(|&f| f64::from(f)).sum::<f64>();
        }
        sum
    }

    /// f of a run of triangles if the candidate joined the set. All columns are cut to one length first, so that the loop needs
    /// no checks and vectorises.
    fn values<const FEWER: usize>(&self, set: &PartnerSet, candidate: &Candidate, start: usize, values: &mut [f32]) {
        let length = values.len();
        let [a0, a1, a2, a3, a4, a5] = set.information.each_ref().map(|c| &c[start..][..length]);
        let [b0, b1, b2, b3, b4, b5] = candidate.information.each_ref().map(|c| &c[start..][..length]);
        let [none, one, two] = set.fewer.each_ref().map(|c| &c[start..][..length]);
        let (resolution, cameras) = (&self.resolution[start..][..length], &set.cameras[start..][..length]);
        let (sees, probability) = (&candidate.sees[start..][..length], &candidate.probability[start..][..length]);
        for i in 0..length {
            let sum = [a0[i] + b0[i], a1[i] + b1[i], a2[i] + b2[i], a3[i] + b3[i], a4[i] + b4[i], a5[i] + b5[i]];
            let quality = resolution[i] + self.uncertainty_weight * smallest_eigenvalue(sum).sqrt();
            let (p, fails) = (probability[i], 1.0 - probability[i]);
            let fewer = [none[i] * fails, one[i] * fails + none[i] * p, two[i] * fails + one[i] * p];
            let failing: f32 = fewer[..FEWER].iter().sum();
            let covered = if cameras[i] + sees[i] >= self.min_cameras { 1.0 } else { 0.0 };
            values[i] = quality * covered * (1.0 - failing);
        }
    }
}

/// Triangles that are judged between two sums.
const CHUNK: usize = 256;

impl Candidate {
    fn unseen(triangles: usize) -> Self {
        Self { information: columns(triangles), sees: vec![0.0; triangles], probability: vec![0.0; triangles] }
    }
}

/// What a set of partners knows of each judging triangle, together with the key view.
#[derive(Clone)]
pub struct PartnerSet {
    information: Columns,
    /// Cameras that see the triangle, the key view included.
    cameras: Vec<f32>,
    /// P(exactly 0, 1, 2 matches succeed).
    fewer: [Vec<f32>; 3],
}

impl PartnerSet {
    fn add(&mut self, candidate: &Candidate) {
        for (sum, column) in self.information.iter_mut().zip(&candidate.information) {
            sum.iter_mut().zip(column).for_each(|(a, b)| *a += b);
        }
        self.cameras.iter_mut().zip(&candidate.sees).for_each(|(a, b)| *a += b);
        let [none, one, two] = &mut self.fewer;
        for (i, &p) in candidate.probability.iter().enumerate() {
            two[i] = two[i] * (1.0 - p) + one[i] * p;
            one[i] = one[i] * (1.0 - p) + none[i] * p;
            none[i] *= 1.0 - p;
        }
    }
}

fn columns(triangles: usize) -> Columns {
    std::array::from_fn(|_| vec![0.0; triangles])
}

fn set(columns: &mut Columns, i: usize, information: &[f64; 6]) {
    columns.iter_mut().zip(information).for_each(|(column, entry)| column[i] = *entry as f32);
}

/// As `Information::smallest_eigenvalue_to_one`, with a fixed number of steps and no branches.
fn smallest_eigenvalue([xx, xy, xz, yy, yz, zz]: [f32; 6]) -> f32 {
    let (m0, m1, m2) = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy);
    let (c2, c1) = (xx + yy + zz, m0 + m1 + m2);
    let c0 = (xx * m0 - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)).max(0.0);
    let mut root = c0 / c1.max(f32::MIN_POSITIVE);
    for _ in 1..STEPS {
        let value = ((c2 - root) * root - c1) * root + c0;
        let slope = (c1 - (2.0 * c2 - 3.0 * root) * root).max(1e-6 * c1).max(f32::MIN_POSITIVE);
        root += (value / slope).max(0.0);
    }
    root.min(1.0)
}
