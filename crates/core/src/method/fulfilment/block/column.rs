//! A partner's column of a block: the information that its pixels add about each triangle, and its
//! pair confidence.

use nalgebra::{Matrix2x3, Matrix3, Vector3};

use super::{
    super::{
        Model,
        lanes::{LANES, Lanes, PartnerLanes},
    },
    Block, TriangleLanes, frame,
    pair_confidence::geometric,
};
use crate::{
    base::vector::Kernel,
    method::confidence::Confidence,
    model::{camera::Camera, scene::ViewIndex},
};

/// The partner's camera relative to the key view.
pub(super) struct PartnerView<'a> {
    camera: &'a Camera,
    /// Camera from world.
    rotation: Matrix3<f64>,
    /// Vector from the key view's centre to the partner's, scene units.
    baseline: [f64; 3],
}

impl<'a> PartnerView<'a> {
    pub(super) fn new(model: &Model<'a>, key: ViewIndex, partner: ViewIndex) -> Self {
        let [key, pose] = [key, partner].map(|v| model.scene.view(v).cam_from_world);
        let baseline = pose.centre() - key.centre();
        Self {
            camera: model.scene.camera_of(partner),
            rotation: *pose.rotation.matrix(),
            baseline: baseline.into(),
        }
    }

    /// Returns the two rows of the Jacobian in the world frame, pixels of the model's image per
    /// scene unit. `rays`: from the partner's centre.
    #[inline(always)]
    fn jacobians(&self, rays: &[[f64; LANES]; 3], sees: &[bool; LANES]) -> [[[f64; LANES]; 3]; 2] {
        if self.camera.is_pinhole() {
            self.pinhole_jacobians(rays)
        } else {
            self.any_jacobians(rays, sees)
        }
    }

    #[inline(always)]
    fn pinhole_jacobians(&self, rays: &[[f64; LANES]; 3]) -> [[[f64; LANES]; 3]; 2] {
        let (focal, _) = self.camera.pinhole_part();
        let r = &self.rotation;
        let mut rows = [[[0.0; LANES]; 3]; 2];
        for i in 0..LANES {
            let ray = [rays[0][i], rays[1][i], rays[2][i]];
            let along =
                |axis: usize| r[(axis, 0)] * ray[0] + r[(axis, 1)] * ray[1] + r[(axis, 2)] * ray[2];
            // Infinite or negative for triangles behind the partner, which it does not see.
            let inverse = 1.0 / along(2);
            let (x, y) = (along(0) * inverse, along(1) * inverse);
            for c in 0..3 {
                rows[0][c][i] = focal.x * inverse * (r[(0, c)] - x * r[(2, c)]);
                rows[1][c][i] = focal.y * inverse * (r[(1, c)] - y * r[(2, c)]);
            }
        }
        rows
    }

    fn any_jacobians(
        &self,
        rays: &[[f64; LANES]; 3],
        sees: &[bool; LANES],
    ) -> [[[f64; LANES]; 3]; 2] {
        let mut rows = [[[0.0; LANES]; 3]; 2];
        // Lens models are projected one by one, without vector instructions, so only what is used.
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

pub(super) struct ColumnKernel<'b, 'a> {
    pub(super) block: &'b Block<'a>,
    pub(super) view: PartnerView<'a>,
    pub(super) partner: usize,
    pub(super) groups: usize,
    /// The groups computed so far; `run` appends.
    pub(super) column: &'b mut Vec<PartnerLanes>,
}

impl Kernel for ColumnKernel<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let (sees, unary) = (
            &self.block.sees[self.partner],
            &self.block.unary[self.partner],
        );
        for group in self.column.len()..self.groups {
            // Arrays of known length: without bounds checks, the loops over lanes become vector
            // instructions.
            let sees: &[bool; LANES] = sees[group * LANES..]
                .first_chunk()
                .expect("padded to whole lanes");
            if !sees.contains(&true) {
                self.column.push(PartnerLanes::EMPTY);
                continue;
            }
            let unary = unary
                .get(group * LANES..)
                .and_then(|rest| rest.first_chunk())
                .unwrap_or(&[1.0; LANES]);
            self.column
                .push(self.group(&self.block.triangles[group], sees, unary));
        }
    }
}

impl ColumnKernel<'_, '_> {
    #[inline(always)]
    fn group(
        &self,
        triangles: &TriangleLanes,
        sees: &[bool; LANES],
        unary: &Lanes,
    ) -> PartnerLanes {
        let mut rays = triangles.ray;
        for (axis, shift) in rays.iter_mut().zip(self.view.baseline) {
            axis.iter_mut().for_each(|x| *x -= shift);
        }
        let jacobians = self.view.jacobians(&rays, sees);
        let chances = self.chances(triangles, &rays);
        // Separate loops: merged, they would compile to a branch per triangle.
        let information = information(triangles, &jacobians, sees);
        let sees = sees.map(|sees| f32::from(u8::from(sees)));
        let mut confidence = [0.0; LANES];
        for i in 0..LANES {
            confidence[i] = chances[i] * unary[i];
        }
        for i in 0..LANES {
            confidence[i] = if sees[i] > 0.0 { confidence[i] } else { 0.0 };
        }
        PartnerLanes {
            information,
            confidence,
            sees,
        }
    }

    /// Returns the pair confidence, where it is not in the unary one already.
    #[inline(always)]
    fn chances(&self, triangles: &TriangleLanes, rays: &[[f64; LANES]; 3]) -> Lanes {
        match &self.block.model.rule.confidence {
            Confidence::None => [1.0; LANES],
            Confidence::Photometric { .. } if self.block.agreed[self.partner] => [1.0; LANES],
            Confidence::Pair(numbers)
            | Confidence::Photometric {
                otherwise: numbers, ..
            } => geometric(numbers, triangles, rays),
        }
    }
}

/// Returns the information of the partner's pixels, in the frame of each triangle's ray and
/// relative to the key view's; 0 where the partner does not see the triangle.
#[inline(always)]
fn information(
    triangles: &TriangleLanes,
    jacobians: &[[[f64; LANES]; 3]; 2],
    sees: &[bool; LANES],
) -> [Lanes; 6] {
    let mut information = PartnerLanes::EMPTY.information;
    for i in 0..LANES {
        let [x, y, z] = &triangles.ray;
        let axes = frame([x[i], y[i], z[i]]);
        let scale = triangles.scale[i];
        let u = in_frame(&jacobians[0], &axes, scale, i);
        let v = in_frame(&jacobians[1], &axes, scale, i);
        let product = |a: usize, b: usize| (u[a] * u[b] + v[a] * v[b]) as f32;
        let values = [
            product(0, 0),
            product(0, 1),
            product(1, 1),
            product(0, 2),
            product(1, 2),
            product(2, 2),
        ];
        for (component, value) in information.iter_mut().zip(values) {
            component[i] = if sees[i] { value } else { 0.0 };
        }
    }
    information
}

/// Returns a row of the Jacobian of one triangle in its frame, times `scale`.
#[inline(always)]
fn in_frame(row: &[[f64; LANES]; 3], axes: &[[f64; 3]; 3], scale: f64, i: usize) -> [f64; 3] {
    let [a, b, c] = axes;
    [
        (row[0][i] * a[0] + row[1][i] * a[1] + row[2][i] * a[2]) * scale,
        (row[0][i] * b[0] + row[1][i] * b[1] + row[2][i] * b[2]) * scale,
        (row[0][i] * c[0] + row[1][i] * c[1] + row[2][i] * c[2]) * scale,
    ]
}
