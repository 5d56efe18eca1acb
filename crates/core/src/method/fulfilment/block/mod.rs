//! Dense arrays (partners x triangles) of a key view's triangles with the contribution of each
//! candidate partner: any set of partners is evaluated by one pass over contiguous memory.

mod column;
mod pair_confidence;
mod sums;

use nalgebra::{Matrix2x3, Vector3};

use self::{
    column::{ColumnKernel, PartnerView},
    sums::{Sums, SumsWith, Values},
};
pub use super::lanes::LANES;
use super::{
    Model, density,
    lanes::{ClusterLanes, KeyLanes, Lanes, PartnerLanes, Weights},
};
use crate::{
    base::vector::vectorised,
    method::confidence::{AtTriangle, Confidence, PairAgreement},
    model::scene::ViewIndex,
};

/// Marks a triangle that is not in the block.
const EMPTY: u32 = u32::MAX;

/// Scratch memory: the slot in the current block of each triangle of the surface. One per thread,
/// reused for every block.
pub struct BlockSlots(Vec<u32>);

impl BlockSlots {
    pub fn new(model: &Model) -> Self {
        Self(vec![EMPTY; model.surface.triangles.len()])
    }
}

/// Triangles that the key view sees, the judging ones first, both parts padded to whole [`LANES`],
/// with the contribution of each partner. The index of a triangle in these arrays is its slot.
pub struct Block<'a> {
    model: Model<'a>,
    key: ViewIndex,
    partners: &'a [ViewIndex],
    weights: Weights,
    /// Slot of each triangle that the key view sees, in the order of its rows of the visibility
    /// table.
    slots: Vec<u32>,
    /// Number of groups of lanes that hold the judging triangles.
    first: usize,
    triangles: Vec<TriangleLanes>,
    keys: Vec<KeyLanes>,
    /// Visibility, by partner, then slot.
    sees: Vec<Vec<bool>>,
    /// By partner, then slot: factor of the key view's and the partner's unary confidence, 0 to 1.
    /// Empty: 1 everywhere.
    unary: Vec<Vec<f32>>,
    /// By partner: true if `unary` holds the probability of a match itself, from comparing pictures
    /// (method 7.4).
    agreed: Vec<bool>,
    /// By partner: the groups of lanes computed so far; the search rarely needs all of them.
    columns: Vec<Vec<PartnerLanes>>,
}

/// Geometry of [`LANES`] triangles.
#[derive(Clone, Copy)]
struct TriangleLanes {
    /// Vector from the key view's centre to the centroid, scene units.
    ray: [[f64; LANES]; 3],
    /// Unit normals.
    normal: [[f32; LANES]; 3],
    /// Cosine of incidence in the key view.
    cosine: [f32; LANES],
    /// Inverse Frobenius norm of the key view's Jacobian, scene units per pixel.
    scale: [f64; LANES],
}

impl TriangleLanes {
    const EMPTY: Self = Self {
        // Not 0: lanes without a triangle are computed, too, and a ray without direction would give
        // NaN.
        ray: [[1.0; LANES]; 3],
        normal: [[0.0; LANES]; 3],
        cosine: [0.0; LANES],
        scale: [0.0; LANES],
    };

    fn set(&mut self, lane: usize, projected: &Projected) {
        for axis in 0..3 {
            self.ray[axis][lane] = projected.ray[axis];
            self.normal[axis][lane] = projected.normal[axis] as f32;
        }
        self.cosine[lane] = projected.cosine as f32;
        self.scale[lane] = projected.scale.recip();
    }
}

/// A triangle in the key view.
struct Projected {
    /// From the camera to the centroid.
    ray: Vector3<f64>,
    normal: Vector3<f64>,
    /// Of incidence.
    cosine: f64,
    /// Pixels of the image per scene unit, in the world frame.
    jacobian: Matrix2x3<f64>,
    /// Frobenius norm of the Jacobian.
    scale: f64,
}

impl Projected {
    /// Returns `None` without a finite scale.
    fn new(model: &Model, key: ViewIndex, triangle: u32) -> Option<Self> {
        let pose = &model.scene.view(key).cam_from_world;
        let centroid = model.surface.centroid(triangle);
        let ray = centroid - pose.centre();
        let normal = model.surface.area_normal(triangle).normalize();
        let camera = model.scene.camera_of(key);
        let (_, jacobian) = camera.project_with_jacobian(&pose.camera_from_world(&centroid))?;
        let jacobian = jacobian * pose.rotation.matrix();
        let scale = jacobian.norm();
        let cosine = -normal.dot(&ray) / ray.norm();
        // The lanes hold the reciprocal of the scale, which must be finite, too.
        let is_usable = scale > 0.0 && (scale + scale.recip()).is_finite() && cosine.is_finite();
        is_usable.then_some(Self {
            ray,
            normal,
            cosine,
            jacobian,
            scale,
        })
    }

    /// Returns xx, xy and yy of the information matrix, in the frame of the ray.
    fn information(&self) -> [f64; 3] {
        let [first, second, _] = frame(self.ray.into());
        let rows = self.jacobian / self.scale;
        let (x, y) = (rows * Vector3::from(first), rows * Vector3::from(second));
        [x.dot(&x), x.dot(&y), y.dot(&y)]
    }
}

/// Slots of triangles.
struct Slots {
    /// Number of groups of lanes that hold the judging triangles, and of all.
    first: usize,
    groups: usize,
    /// By triangle.
    slots: Vec<u32>,
}

impl Slots {
    fn new(seen: &[u32], is_judge: impl Fn(u32) -> bool) -> Self {
        let judges = seen.iter().filter(|&&t| is_judge(t)).count();
        let first = judges.div_ceil(LANES);
        let mut next = [0, (first * LANES) as u32];
        let slot = |&t: &u32| {
            let next = &mut next[usize::from(!is_judge(t))];
            *next += 1;
            *next - 1
        };
        Self {
            first,
            groups: first + (seen.len() - judges).div_ceil(LANES),
            slots: seen.iter().map(slot).collect(),
        }
    }
}

impl<'a> Block<'a> {
    /// Bytes of the block of a key view that sees `triangles`, with all columns of its partners
    /// computed.
    pub fn bytes(triangles: u64, partners: u64) -> u64 {
        let groups = triangles.div_ceil(LANES as u64) + 1;
        let of_partner = size_of::<PartnerLanes>() + LANES * (size_of::<bool>() + size_of::<f32>());
        let own = size_of::<TriangleLanes>() + size_of::<KeyLanes>() + LANES * size_of::<u32>();
        groups * (own as u64 + partners * of_partner as u64)
    }

    /// Gathers the triangles that `key` sees. `is_judge` selects those that choices are judged by;
    /// they come first.
    pub fn new(
        model: &Model<'a>,
        key: ViewIndex,
        partners: &'a [ViewIndex],
        is_judge: impl Fn(u32) -> bool,
        slots: &mut BlockSlots,
    ) -> Self {
        let Slots {
            first,
            groups,
            slots: own,
        } = Slots::new(model.visibility.triangles_seen_by(key), is_judge);
        let mut block = Self {
            model: *model,
            key,
            partners,
            weights: Weights::new(&model.rule),
            slots: own,
            first,
            triangles: vec![TriangleLanes::EMPTY; groups],
            keys: vec![KeyLanes::EMPTY; groups],
            sees: vec![vec![false; groups * LANES]; partners.len()],
            unary: Vec::new(),
            agreed: Vec::new(),
            columns: vec![Vec::new(); partners.len()],
        };
        block.gather_triangles();
        block.gather_partners(&mut slots.0);
        block
    }

    /// Number of groups of lanes that hold judging triangles.
    pub fn first(&self) -> usize {
        self.first
    }

    /// Number of groups of lanes.
    pub(crate) fn len(&self) -> usize {
        self.keys.len()
    }

    /// Computes what depends on the key view alone. Triangles that project to no finite scale keep
    /// their empty lanes, so that f is 0.
    fn gather_triangles(&mut self) {
        let model = self.model;
        let per_px = model.rule.image_scale / model.rule.sigma_px;
        let seen = model.visibility.triangles_seen_by(self.key);
        for (&t, &slot) in seen.iter().zip(&self.slots) {
            let Some(projected) = Projected::new(&model, self.key, t) else {
                continue;
            };
            let (group, lane) = (slot as usize / LANES, slot as usize % LANES);
            self.triangles[group].set(lane, &projected);
            let gsd = f64::from(model.target.gsd[t as usize]);
            let resolution = (density(&model, self.key, t) * gsd * gsd).min(1.0);
            let key = &mut self.keys[group];
            key.set_information(lane, projected.information());
            key.unit[lane] = (model.target.accuracy(t) * projected.scale * per_px) as f32;
            key.resolution[lane] = (model.rule.alpha * resolution) as f32;
        }
    }

    /// Computes visibility and unary confidence of each partner.
    fn gather_partners(&mut self, slot_of: &mut [u32]) {
        let model = self.model;
        let seen = model.visibility.triangles_seen_by(self.key);
        for (&t, &slot) in seen.iter().zip(&self.slots) {
            slot_of[t as usize] = slot;
        }
        let own = self.own_unary();
        for partner in 0..self.partners.len() {
            for slot in self.slots_seen_by(partner, slot_of).map(|(_, slot)| slot) {
                self.sees[partner][slot] = true;
            }
            let chances = self.agreed_chances(partner);
            self.agreed.push(chances.is_some());
            let unary = chances.unwrap_or_else(|| self.unary_factors(partner, &own, slot_of));
            self.unary.push(unary);
        }
        // Only the entries that were set: the array is as long as the surface has triangles.
        seen.iter().for_each(|&t| slot_of[t as usize] = EMPTY);
    }

    /// Returns the rows of a partner's visibility that have a slot, with it.
    fn slots_seen_by<'s>(
        &self,
        partner: usize,
        slot_of: &'s [u32],
    ) -> impl Iterator<Item = (usize, usize)> + use<'s, 'a> {
        let seen = self
            .model
            .visibility
            .triangles_seen_by(self.partners[partner]);
        let slots = seen.iter().map(|&t| slot_of[t as usize]).enumerate();
        slots
            .filter(|(_, slot)| *slot != EMPTY)
            .map(|(row, slot)| (row, slot as usize))
    }

    /// Returns the unary factors of both views by slot, given those of the key view.
    fn unary_factors(&self, partner: usize, own: &[AtTriangle], slot_of: &[u32]) -> Vec<f32> {
        let (model, view) = (&self.model, self.partners[partner]);
        let mut factors = vec![0.0; own.len()];
        let unary = model.unary.of_rows(model.visibility.rows(view));
        for (row, slot) in self.slots_seen_by(partner, slot_of) {
            if let Some(own) = own.get(slot) {
                factors[slot] = own.with(unary.at(row)) as f32;
            }
        }
        factors
    }

    /// Returns the probability of a match by slot if the pictures of the pair were compared.
    fn agreed_chances(&self, partner: usize) -> Option<Vec<f32>> {
        let Confidence::Photometric { agreement, .. } = self.model.rule.confidence else {
            return None;
        };
        let mut chances = vec![0.0; self.len() * LANES];
        match self
            .model
            .agreement
            .of_pair(self.key, self.partners[partner])
        {
            PairAgreement::NoPicture => return None,
            // Not expected to match (method 7.4): the chances stay 0.
            PairAgreement::NoCandidate => {}
            PairAgreement::Compared(values) => {
                for (&value, &slot) in values.iter().zip(&self.slots) {
                    chances[slot as usize] = agreement.chance(value) as f32;
                }
            }
        }
        Some(chances)
    }

    /// Returns the unary confidence of the key view by slot; nothing where it is 1 everywhere.
    fn own_unary(&self) -> Vec<AtTriangle> {
        let model = &self.model;
        if model.unary.is_certain() {
            return Vec::new();
        }
        let nothing = AtTriangle {
            observed: 0.0,
            allowed: 0.0,
        };
        let mut own = vec![nothing; self.len() * LANES];
        let unary = model.unary.of_rows(model.visibility.rows(self.key));
        for (row, &slot) in self.slots.iter().enumerate() {
            own[slot as usize] = unary.at(row);
        }
        own
    }

    /// Computes the partner's column up to at least `groups` groups of lanes.
    pub fn extend(&mut self, partner: usize, groups: usize) {
        let mut column = std::mem::take(&mut self.columns[partner]);
        if column.len() < groups {
            let view = PartnerView::new(&self.model, self.key, self.partners[partner]);
            // All at once and no more: a column that doubled as it grows would exceed the forecast
            // of `bytes`.
            column.reserve_exact(self.len() - column.len());
            vectorised(ColumnKernel {
                block: self,
                view,
                partner,
                groups,
                column: &mut column,
            });
        }
        self.columns[partner] = column;
    }

    /// Returns, for each set of partners, the sum of f over the judging triangles. f is computed in
    /// f32: precise enough to choose by, not to report.
    pub fn sums(&mut self, sets: &[Vec<usize>], judges: Judges) -> Vec<f64> {
        sets.iter()
            .flatten()
            .for_each(|&p| self.extend(p, judges.groups));
        vectorised(Sums {
            block: self,
            sets,
            judges,
        })
    }

    /// Returns the sum of f over the judging triangles for `base` plus each one of `added`; f in
    /// f32.
    pub fn sums_with(&mut self, base: &[usize], added: &[usize], judges: Judges) -> Vec<f64> {
        base.iter()
            .chain(added)
            .for_each(|&p| self.extend(p, judges.groups));
        vectorised(SumsWith {
            block: self,
            base,
            added,
            judges,
        })
    }

    /// Returns f of each triangle that the key view sees, in the order of its rows, with the
    /// precision of the plan (f64 inside).
    pub fn values(&mut self, set: &[usize]) -> Vec<f32> {
        set.iter().for_each(|&p| self.extend(p, self.len()));
        self.by_row(&vectorised(Values { block: self, set }))
    }

    /// Returns f_cov * f_conf of each triangle that the key view sees, in the order of its rows.
    pub fn chances(&mut self, set: &[usize]) -> Vec<f32> {
        set.iter().for_each(|&p| self.extend(p, self.len()));
        let of_group = |group| self.together(set, group).chance(&self.weights);
        self.by_row(&(0..self.len()).map(of_group).collect::<Vec<_>>())
    }

    #[cfg(test)]
    pub fn held(&self) -> usize {
        let of_partners = self
            .columns
            .iter()
            .map(|column| size_of::<PartnerLanes>() * column.capacity())
            .sum::<usize>();
        let rows = self.sees.iter().map(Vec::capacity).sum::<usize>()
            + size_of::<f32>() * self.unary.iter().map(Vec::capacity).sum::<usize>();
        let own = size_of_val(&self.slots[..])
            + size_of_val(&self.triangles[..])
            + size_of_val(&self.keys[..]);
        own + rows + of_partners
    }

    fn by_row(&self, lanes: &[Lanes]) -> Vec<f32> {
        self.slots
            .iter()
            .map(|&slot| lanes[slot as usize / LANES][slot as usize % LANES])
            .collect()
    }

    #[inline(always)]
    fn together(&self, set: &[usize], group: usize) -> ClusterLanes {
        // A loop rather than an iterator adaptor, here and below: the adaptor's closure could be
        // compiled separately, without the vector instructions.
        let mut together = ClusterLanes::new(&self.keys[group]);
        for &partner in set {
            together = together.with(&self.columns[partner][group]);
        }
        together
    }
}

/// A sample of the judging triangles: every `step`-th of the first `groups` groups of lanes.
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

/// Returns an orthonormal frame: two unit vectors perpendicular to the ray, then the unit vector
/// opposite to it.
///
/// Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017).
#[inline(always)]
fn frame(ray: [f64; 3]) -> [[f64; 3]; 3] {
    let inverse = -1.0 / (ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]).sqrt();
    let d = [ray[0] * inverse, ray[1] * inverse, ray[2] * inverse];
    let sign = if d[2] >= 0.0 { 1.0 } else { -1.0 };
    let a = -1.0 / (sign + d[2]);
    let b = d[0] * d[1] * a;
    [
        [1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0]],
        [b, sign + d[1] * d[1] * a, -d[1]],
        d,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_orthonormal_whatever_the_ray() {
        for ray in [
            [0.0, 0.0, 3.0],
            [0.0, 0.0, -3.0],
            [1.0, -2.0, 0.5],
            [0.1, 0.2, -4.0],
            [5.0, 0.0, 0.0],
        ] {
            let axes = frame(ray).map(Vector3::from);
            for (i, a) in axes.iter().enumerate() {
                for (j, b) in axes.iter().enumerate() {
                    assert!(
                        (a.dot(b) - f64::from(u8::from(i == j))).abs() < 1e-12,
                        "{ray:?} {i} {j}"
                    );
                }
            }
            assert!((axes[2] + Vector3::from(ray).normalize()).norm() < 1e-12);
        }
    }
}
