//! A key view's triangles with all its possible partners, gathered once into dense arrays (triangles x partners), so that any set of
//! partners can be judged by running over contiguous memory.

use nalgebra::{Matrix2x3, Matrix3, Vector3};

pub use super::lanes::LANES;
use super::{
    Model, density,
    lanes::{ClusterLanes, KeyLanes, Lanes, PartnerLanes, Weights, angle_of_chord, exp2, log2},
};
use crate::{
    base::vector::{Kernel, vectorised},
    method::confidence::{Confidence, Constellation, PairAgreement, PairConfidence, PairCurves, trees::logistic},
    model::{camera::Camera, scene::ViewIndex},
};

/// No triangle stands here.
const EMPTY: u32 = u32::MAX;

/// For each triangle its place in the block of the key view at hand; one per thread, used again.
pub struct BlockSlots(Vec<u32>);

impl BlockSlots {
    pub fn new(model: &Model) -> Self {
        Self(vec![EMPTY; model.surface.triangles.len()])
    }
}

/// The key view's triangles in a certain order, padded to whole [`LANES`], and what each partner adds to them.
pub struct Block<'a> {
    model: Model<'a>,
    key: ViewIndex,
    partners: &'a [ViewIndex],
    weights: Weights,
    /// Place in the block of each triangle that the key view sees, in the order of its rows.
    places: Vec<u32>,
    /// Groups of lanes that hold the first part of the triangles, those that choices are judged by.
    first: usize,
    triangles: Vec<TriangleLanes>,
    keys: Vec<KeyLanes>,
    /// By partner, by place.
    sees: Vec<Vec<bool>>,
    /// By partner, by place: mean of the two unary confidences, or the partner's log odds where the confidence is trained; empty where the
    /// mean is 1.
    unary: Vec<Vec<f32>>,
    /// By partner: `unary` is the chance of a match itself (method 7.4).
    agreed: Vec<bool>,
    /// By partner: as many groups of lanes as were needed so far.
    columns: Vec<Vec<PartnerLanes>>,
}

/// Where some triangles are.
#[derive(Clone, Copy)]
struct TriangleLanes {
    /// Key view's centre to centroid, scene units.
    ray: [[f64; LANES]; 3],
    /// Unit normals.
    normal: [[f32; LANES]; 3],
    /// Cosine of incidence in the key view.
    cosine: [f32; LANES],
    /// One over the length (root of the sum of squares) of the key view's Jacobian, scene units per pixel.
    scale: [f64; LANES],
}

impl TriangleLanes {
    const EMPTY: Self =
        Self { ray: [[1.0; LANES]; 3], normal: [[0.0; LANES]; 3], cosine: [0.0; LANES], scale: [0.0; LANES] };
}

impl<'a> Block<'a> {
    /// `is_first`: the triangles that come first.
    pub fn new(
        model: &Model<'a>,
        key: ViewIndex,
        partners: &'a [ViewIndex],
        is_first: impl Fn(u32) -> bool,
        slots: &mut BlockSlots,
    ) -> Self {
        let rule = &model.rule;
        let seen = model.visibility.triangles_seen_by(key);
        let count = seen.iter().filter(|&&t| is_first(t)).count();
        let (first, all) = (count.div_ceil(LANES), count.div_ceil(LANES) + (seen.len() - count).div_ceil(LANES));
        let mut next = [0, (first * LANES) as u32];
        let place = |&t: &u32| {
            let next = &mut next[usize::from(!is_first(t))];
            *next += 1;
            *next - 1
        };
        let mut block = Self {
            model: *model,
            key,
            partners,
            weights: Weights {
                uncertainty: (1.0 - rule.alpha) as f32,
                min_partners: rule.min_cameras.saturating_sub(1) as f32,
                min_matches: rule.confidence.min_matches().min(3),
            },
            places: seen.iter().map(place).collect(),
            first,
            triangles: vec![TriangleLanes::EMPTY; all],
            keys: vec![KeyLanes::EMPTY; all],
            sees: vec![vec![false; all * LANES]; partners.len()],
            unary: Vec::new(),
            agreed: Vec::new(),
            columns: vec![Vec::new(); partners.len()],
        };
        block.place_triangles();
        block.place_views(&mut slots.0);
        block
    }

    /// Groups of lanes of the first triangles.
    pub fn first(&self) -> usize {
        self.first
    }

    /// Groups of lanes of all triangles.
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// What depends on the key view alone.
    fn place_triangles(&mut self) {
        let model = &self.model;
        let (camera, pose) = (model.scene.camera_of(self.key), &model.scene.view(self.key).cam_from_world);
        let centre = pose.centre();
        let rows = model.visibility.rows(self.key);
        for ((row, &t), &place) in rows.zip(model.visibility.triangles_seen_by(self.key)).zip(&self.places) {
            let (group, lane) = (place as usize / LANES, place as usize % LANES);
            let centroid = model.surface.centroid(t);
            let ray = centroid - centre;
            let normal = model.surface.area_normal(t).normalize();
            let jacobian = camera.project_with_jacobian(&pose.camera_from_world(&centroid)).map(|p| p.1);
            let jacobian = jacobian.unwrap_or_else(Matrix2x3::zeros) * pose.rotation.matrix();
            let length = jacobian.norm();
            let cosine = -normal.dot(&ray) / ray.norm();
            let usable = length > 0.0 && (length + length.recip()).is_finite() && cosine.is_finite();
            if !usable {
                continue;
            }
            let (lanes, key) = (&mut self.triangles[group], &mut self.keys[group]);
            for axis in 0..3 {
                lanes.ray[axis][lane] = ray[axis];
                lanes.normal[axis][lane] = normal[axis] as f32;
            }
            lanes.cosine[lane] = cosine as f32;
            lanes.scale[lane] = length.recip();
            let [first, second, _] = frame([ray.x, ray.y, ray.z]);
            let rows = jacobian / length;
            let (x, y) = (rows * Vector3::from(first), rows * Vector3::from(second));
            for (component, value) in key.information.iter_mut().zip([x.dot(&x), x.dot(&y), y.dot(&y)]) {
                component[lane] = value as f32;
            }
            let per_px = model.rule.image_scale / model.rule.sigma_px;
            key.unit[lane] = (model.target.accuracy(t) * length * per_px) as f32;
            key.measurable[lane] = model.rule.confidence.measurable(model.unary.confidence(row));
            let gsd = f64::from(model.target.gsd[t as usize]);
            key.resolution[lane] = (model.rule.alpha * (density(model, self.key, t) * gsd * gsd).min(1.0)) as f32;
        }
    }

    /// Which partner sees what, and how sure it is.
    fn place_views(&mut self, place_of: &mut [u32]) {
        let model = &self.model;
        let seen = model.visibility.triangles_seen_by(self.key);
        seen.iter().zip(&self.places).for_each(|(&t, &place)| place_of[t as usize] = place);
        let trained = matches!(model.rule.confidence, Confidence::Trained(_));
        let own: Vec<f32> = if model.unary.values.is_empty() { Vec::new() } else { self.own_unary() };
        for (&partner, sees) in self.partners.iter().zip(&mut self.sees) {
            let mut means = vec![0.0; own.len()];
            for (row, &t) in model.visibility.rows(partner).zip(model.visibility.triangles_seen_by(partner)) {
                let place = place_of[t as usize];
                if place != EMPTY {
                    sees[place as usize] = true;
                    if trained {
                        means[place as usize] = model.unary.as_partner(row);
                    } else if !own.is_empty() {
                        means[place as usize] = 0.5 * (own[place as usize] + model.unary.confidence(row));
                    }
                }
            }
            self.unary.push(means);
        }
        seen.iter().for_each(|&t| place_of[t as usize] = EMPTY);
        for partner in 0..self.partners.len() {
            let chances = self.agreed_chances(partner);
            self.agreed.push(chances.is_some());
            if let Some(chances) = chances {
                self.unary[partner] = chances;
            }
        }
    }

    /// By place: the chance of a match, where the pictures of the pair were compared.
    fn agreed_chances(&self, partner: usize) -> Option<Vec<f32>> {
        let Confidence::Photometric { agreement, .. } = self.model.rule.confidence else { return None };
        let mut chances = vec![0.0; self.len() * LANES];
        match self.model.agreement.of_pair(self.key, self.partners[partner]) {
            PairAgreement::NoPicture => return None,
            PairAgreement::NoCandidate => {}
            PairAgreement::Compared(values) => {
                for (&value, &place) in values.iter().zip(&self.places) {
                    chances[place as usize] = agreement.chance(value) as f32;
                }
            }
        }
        Some(chances)
    }

    fn own_unary(&self) -> Vec<f32> {
        let mut own = vec![0.0; self.len() * LANES];
        for (row, &place) in self.model.visibility.rows(self.key).zip(&self.places) {
            own[place as usize] = self.model.unary.confidence(row);
        }
        own
    }

    /// Makes the partner's column at least `groups` long.
    pub fn extend(&mut self, partner: usize, groups: usize) {
        let mut column = std::mem::take(&mut self.columns[partner]);
        if column.len() < groups {
            let view = PartnerView::new(&self.model, self.key, self.partners[partner]);
            column.reserve_exact(self.len() - column.len());
            vectorised(Column { block: self, view, partner, groups, column: &mut column });
        }
        self.columns[partner] = column;
    }

    /// Sum of f over the judges for each set of partners; f in f32, good for choosing.
    pub fn sums(&mut self, sets: &[Vec<usize>], judges: Judges) -> Vec<f64> {
        sets.iter().flatten().for_each(|&p| self.extend(p, judges.groups));
        vectorised(Sums { block: self, sets, judges })
    }

    /// Sum of f over the judges for `base` together with each of `added`; f in f32.
    pub fn sums_with(&mut self, base: &[usize], added: &[usize], judges: Judges) -> Vec<f64> {
        base.iter().chain(added).for_each(|&p| self.extend(p, judges.groups));
        vectorised(SumsWith { block: self, base, added, judges })
    }

    /// f of each triangle that the key view sees, in the order of its rows, as it is written.
    pub fn values(&mut self, set: &[usize]) -> Vec<f32> {
        set.iter().for_each(|&p| self.extend(p, self.len()));
        self.by_row(&vectorised(Values { block: self, set }))
    }

    /// f_cov f_conf of each triangle that the key view sees, in the order of its rows.
    pub fn chances(&mut self, set: &[usize]) -> Vec<f32> {
        set.iter().for_each(|&p| self.extend(p, self.len()));
        let of_group = |group| self.together(set, group).chance(&self.keys[group], &self.weights);
        self.by_row(&(0..self.len()).map(of_group).collect::<Vec<_>>())
    }

    fn by_row(&self, lanes: &[Lanes]) -> Vec<f32> {
        self.places.iter().map(|&place| lanes[place as usize / LANES][place as usize % LANES]).collect()
    }

    #[inline(always)]
    fn together(&self, set: &[usize], group: usize) -> ClusterLanes {
        // A loop and no iterator adaptor here and below: its closure could be compiled apart, without the instructions that this is about.
        let mut together = ClusterLanes::new(&self.keys[group]);
        for &partner in set {
            together = together.with(&self.columns[partner][group]);
        }
        together
    }
}

/// The triangles that choices are judged by: every `step`-th of the first `groups` groups of lanes.
#[derive(Clone, Copy, Debug)]
pub struct Judges {
    pub groups: usize,
    /// At least 1.
    pub step: usize,
}

impl Judges {
    #[inline(always)]
    fn iter(self) -> impl Iterator<Item = usize> {
        (0..self.groups).step_by(self.step)
    }
}

struct Sums<'b, 'a> {
    block: &'b Block<'a>,
    sets: &'b [Vec<usize>],
    judges: Judges,
}

impl Kernel for Sums<'_, '_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn run(self) -> Vec<f64> {
        let mut sums = vec![[0.0; LANES]; self.sets.len()];
        for group in self.judges.iter() {
            let key = &self.block.keys[group];
            for (set, sum) in self.sets.iter().zip(&mut sums) {
                add(sum, self.block.together(set, group).value::<f32>(key, &self.block.weights));
            }
        }
        sums.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

struct SumsWith<'b, 'a> {
    block: &'b Block<'a>,
    base: &'b [usize],
    added: &'b [usize],
    judges: Judges,
}

impl Kernel for SumsWith<'_, '_> {
    type Output = Vec<f64>;

    #[inline(always)]
    fn run(self) -> Vec<f64> {
        let mut sums = vec![[0.0; LANES]; self.added.len()];
        for group in self.judges.iter() {
            let key = &self.block.keys[group];
            let base = self.block.together(self.base, group);
            for (&partner, sum) in self.added.iter().zip(&mut sums) {
                let with = base.with(&self.block.columns[partner][group]);
                add(sum, with.value::<f32>(key, &self.block.weights));
            }
        }
        sums.iter().map(|lanes| lanes.iter().sum()).collect()
    }
}

#[inline(always)]
fn add(sum: &mut [f64; LANES], values: [f32; LANES]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += f64::from(value);
    }
}

struct Values<'b, 'a> {
    block: &'b Block<'a>,
    set: &'b [usize],
}

impl Kernel for Values<'_, '_> {
    type Output = Vec<[f32; LANES]>;

    #[inline(always)]
    fn run(self) -> Vec<[f32; LANES]> {
        let mut values = Vec::with_capacity(self.block.len());
        for group in 0..self.block.len() {
            let together = self.block.together(self.set, group);
            values.push(together.value::<f64>(&self.block.keys[group], &self.block.weights).map(|f| f as f32));
        }
        values
    }
}

/// What a partner's column is made from.
struct PartnerView<'a> {
    camera: &'a Camera,
    /// Camera from world.
    rotation: Matrix3<f64>,
    /// Key view's centre to partner's.
    baseline: [f64; 3],
}

impl<'a> PartnerView<'a> {
    fn new(model: &Model<'a>, key: ViewIndex, partner: ViewIndex) -> Self {
        let [key, pose] = [key, partner].map(|v| model.scene.view(v).cam_from_world);
        let baseline = pose.centre() - key.centre();
        Self { camera: model.scene.camera_of(partner), rotation: *pose.rotation.matrix(), baseline: baseline.into() }
    }

    /// Rows of the Jacobian in the world frame, pixels of the model's image per scene unit, from the rays of the partner.
    #[inline(always)]
    fn jacobians(&self, rays: &[[f64; LANES]; 3], sees: &[bool; LANES]) -> [[[f64; LANES]; 3]; 2] {
        if self.camera.is_pinhole() { self.pinhole_jacobians(rays) } else { self.any_jacobians(rays, sees) }
    }

    #[inline(always)]
    fn pinhole_jacobians(&self, rays: &[[f64; LANES]; 3]) -> [[[f64; LANES]; 3]; 2] {
        let (focal, _) = self.camera.pinhole_part();
        let r = &self.rotation;
        let mut rows = [[[0.0; LANES]; 3]; 2];
        for i in 0..LANES {
            let ray = [rays[0][i], rays[1][i], rays[2][i]];
            let along = |axis: usize| r[(axis, 0)] * ray[0] + r[(axis, 1)] * ray[1] + r[(axis, 2)] * ray[2];
            let inverse = 1.0 / along(2);
            let (x, y) = (along(0) * inverse, along(1) * inverse);
            for c in 0..3 {
                rows[0][c][i] = focal.x * inverse * (r[(0, c)] - x * r[(2, c)]);
                rows[1][c][i] = focal.y * inverse * (r[(1, c)] - y * r[(2, c)]);
            }
        }
        rows
    }

    fn any_jacobians(&self, rays: &[[f64; LANES]; 3], sees: &[bool; LANES]) -> [[[f64; LANES]; 3]; 2] {
        let mut rows = [[[0.0; LANES]; 3]; 2];
        for i in (0..LANES).filter(|&i| sees[i]) {
            let ray = self.rotation * Vector3::new(rays[0][i], rays[1][i], rays[2][i]);
            let projected = self.camera.project_with_jacobian(&ray.into());
            let jacobian = projected.map_or_else(Matrix2x3::zeros, |p| p.1) * self.rotation;
            for (row, c) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)] {
                rows[row][c][i] = jacobian[(row, c)];
            }
        }
        rows
    }
}

struct Column<'b, 'a> {
    block: &'b Block<'a>,
    view: PartnerView<'a>,
    partner: usize,
    groups: usize,
    /// What there is of it so far.
    column: &'b mut Vec<PartnerLanes>,
}

impl Kernel for Column<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (sees, unary) = (&self.block.sees[self.partner], &self.block.unary[self.partner]);
        for group in self.column.len()..self.groups {
            // Arrays of known length: no bounds are checked in the loops over lanes, so that they become vector instructions.
            let sees: &[bool; LANES] = sees[group * LANES..].first_chunk().expect("padded to whole lanes");
            if !sees.contains(&true) {
                self.column.push(PartnerLanes::EMPTY);
                continue;
            }
            let unary = unary.get(group * LANES..).and_then(|rest| rest.first_chunk()).unwrap_or(&[1.0; LANES]);
            self.column.push(self.group(&self.block.triangles[group], sees, unary));
        }
    }
}

impl Column<'_, '_> {
    #[inline(always)]
    fn group(&self, triangles: &TriangleLanes, sees: &[bool; LANES], unary: &Lanes) -> PartnerLanes {
        let mut rays = triangles.ray;
        for (axis, shift) in rays.iter_mut().zip(self.view.baseline) {
            axis.iter_mut().for_each(|x| *x -= shift);
        }
        let jacobians = self.view.jacobians(&rays, sees);
        let mut out = PartnerLanes::EMPTY;
        for i in 0..LANES {
            let axes = frame([triangles.ray[0][i], triangles.ray[1][i], triangles.ray[2][i]]);
            let scale = triangles.scale[i];
            let along = |row: &[[f64; LANES]; 3], axis: &[f64; 3]| {
                (row[0][i] * axis[0] + row[1][i] * axis[1] + row[2][i] * axis[2]) * scale
            };
            let u = [along(&jacobians[0], &axes[0]), along(&jacobians[0], &axes[1]), along(&jacobians[0], &axes[2])];
            let v = [along(&jacobians[1], &axes[0]), along(&jacobians[1], &axes[1]), along(&jacobians[1], &axes[2])];
            let product = |a: usize, b: usize| (u[a] * u[b] + v[a] * v[b]) as f32;
            let values = [product(0, 0), product(0, 1), product(1, 1), product(0, 2), product(1, 2), product(2, 2)];
            for (component, value) in out.information.iter_mut().zip(values) {
                component[i] = if sees[i] { value } else { 0.0 };
            }
        }
        let chances = match &self.block.model.rule.confidence {
            Confidence::None => [1.0; LANES],
            Confidence::Paper { .. } => [1.0; LANES],
            Confidence::Photometric { .. } if self.block.agreed[self.partner] => [1.0; LANES],
            Confidence::Pair(numbers) | Confidence::Photometric { otherwise: numbers, .. } => {
                geometric(numbers, triangles, &rays)
            }
            Confidence::Trained(curves) => trained(curves, triangles, &rays, unary, sees),
        };
        let factors =
            if matches!(self.block.model.rule.confidence, Confidence::Trained(_)) { &[1.0; LANES] } else { unary };
        // One step at a time: together they would become jumps for each triangle.
        out.sees = sees.map(|sees| f32::from(u8::from(sees)));
        for i in 0..LANES {
            out.confidence[i] = chances[i] * factors[i];
        }
        for i in 0..LANES {
            out.confidence[i] = if out.sees[i] > 0.0 { out.confidence[i] } else { 0.0 };
        }
        out
    }
}

/// [`Confidence::pair`] of a trained confidence for partners with these rays and log odds.
fn trained(
    curves: &PairCurves,
    triangles: &TriangleLanes,
    rays: &[[f64; LANES]; 3],
    odds: &[f32],
    sees: &[bool],
) -> Lanes {
    let mut chances = [0.0; LANES];
    for i in (0..LANES).filter(|&i| sees[i]) {
        let at = |v: &[[f64; LANES]; 3]| Vector3::new(v[0][i], v[1][i], v[2][i]);
        let (key, own) = (at(&triangles.ray), at(rays));
        let normal = triangles.normal.map(|axis| f64::from(axis[i]));
        let constellation = Constellation {
            cos_key: f64::from(triangles.cosine[i]),
            cos_partner: -Vector3::from(normal).dot(&own) / own.norm(),
            octaves: (own.norm() / key.norm()).log2(),
            angle_deg: key.angle(&own).to_degrees(),
        };
        chances[i] = logistic(curves.odds(&constellation.numbers()) + odds[i]);
    }
    chances
}

/// [`PairConfidence::confidence`] for partners with these rays, relative error below 1e-6.
#[inline(always)]
fn geometric(numbers: &PairConfidence, triangles: &TriangleLanes, rays: &[[f64; LANES]; 3]) -> Lanes {
    let mut chance = [numbers.p0 as f32; LANES];
    let squared = |v: &[[f64; LANES]; 3], i: usize| v[0][i] * v[0][i] + v[1][i] * v[1][i] + v[2][i] * v[2][i];
    let (mut cosines, mut ratios, mut chords) = ([0.0f32; LANES], [0.0f32; LANES], [0.0f32; LANES]);
    for i in 0..LANES {
        let (key, own) = (squared(&triangles.ray, i), squared(rays, i));
        let (to_key, to_own) = (1.0 / key.sqrt(), 1.0 / own.sqrt());
        let (mut dot, mut chord) = (0.0, 0.0);
        for ((normal, key_ray), ray) in triangles.normal.iter().zip(&triangles.ray).zip(rays) {
            dot -= f64::from(normal[i]) * ray[i];
            let apart = key_ray[i] * to_key - ray[i] * to_own;
            chord += apart * apart;
        }
        let cosine = (dot * to_own) as f32;
        cosines[i] = if cosine < triangles.cosine[i] { cosine } else { triangles.cosine[i] };
        ratios[i] = (own / key) as f32;
        chords[i] = chord as f32;
    }
    let power = numbers.cosine_power as f32;
    for i in 0..LANES {
        // A triangle that is seen is seen from its front; the others are not asked.
        let cosine = if cosines[i] > 1e-6 { cosines[i] } else { 1e-6 };
        chance[i] *= if power == 1.0 { cosine } else { exp2(power * log2(cosine)) };
    }
    if let Some(octaves) = numbers.scale_octaves {
        // exp(-x^2 / 2) as a power of 2, x half the logarithm of the squared ratio over `octaves`.
        let factor = (-0.125 * std::f64::consts::LOG2_E / (octaves * octaves)) as f32;
        for i in 0..LANES {
            let twice = log2(if ratios[i] > 1e-30 { ratios[i] } else { 1e-30 });
            chance[i] *= exp2(factor * twice * twice);
        }
    }
    if let Some(degrees) = numbers.full_angle_deg {
        let per_full = (1.0 / degrees.to_radians()) as f32;
        for i in 0..LANES {
            let share = angle_of_chord(chords[i]) * per_full;
            chance[i] *= if share < 1.0 { share } else { 1.0 };
        }
    }
    chance.map(|c| if c > 0.0 { if c < 1.0 { c } else { 1.0 } } else { 0.0 })
}

/// Two unit vectors across a ray, and the direction against it.
///
/// Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017).
#[inline(always)]
fn frame(ray: [f64; 3]) -> [[f64; 3]; 3] {
    let inverse = -1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]).sqrt();
    let d = [ray[0] * inverse, ray[1] * inverse, ray[2] * inverse];
    let sign = if d[2] >= 0.0 { 1.0 } else { -1.0 };
    let a = -1.0 / (sign + d[2]);
    let b = d[0] * d[1] * a;
    [[1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0]], [b, sign + d[1] * d[1] * a, -d[1]], d]
}
