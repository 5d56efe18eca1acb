//! What one view sees, from buffers of what is in front and, for small triangles, rays.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use nalgebra::{Point3, Vector3};

use super::{
    MOST_LAYERS, NOTHING, VisibilitySettings,
    buffer::{Buffer, Face, FacePoint, Tolerance},
    patches::{Patch, Patches},
};
use crate::{
    base::bits,
    model::{
        camera::{Camera, CameraModel},
        scene::{PointIndex, Pose, Scene, ViewIndex},
        surface::Surface,
    },
};

/// Triangles that cover fewer pixels are sampled by rays (method 2).
const FEW_PIXELS: u32 = 4;
/// Near plane, edge lengths: nothing closer to the camera is drawn.
const NEAR_EDGES: f64 = 0.05;

/// The inputs that all views share.
pub(super) struct Estimator<'a> {
    scene: &'a Scene,
    surface: &'a Surface,
    patches: Patches,
    /// Faces of each camera.
    faces: Vec<Vec<Face>>,
    tolerance: Tolerance,
    near: f64,
    /// Squared cosine of the largest allowed angle of incidence.
    cos2: f64,
    min_free_share: f64,
}

/// Buffers of one view; one per thread, reused.
#[derive(Default)]
pub(super) struct RenderedView {
    buffers: Vec<Buffer>,
    /// Indices of the patches in the field.
    drawn: Vec<usize>,
    candidates: Vec<Candidate>,
    /// Vertices of the current patch in camera coordinates, and on a face.
    vertices: Vec<Point3<f64>>,
    projected: Vec<FacePoint>,
    /// Pixels that each triangle of the current patch covers.
    covered: Vec<u32>,
    /// Pixels in which each triangle is frontmost, all 0 between uses.
    in_front: Vec<u32>,
    /// A bit for each triangle, all zero between uses.
    seen: Vec<u64>,
}

impl RenderedView {
    /// Forgets the view before.
    fn clear(&mut self, faces: &[Face]) {
        self.candidates.clear();
        self.drawn.clear();
        self.buffers.resize_with(faces.len(), Buffer::default);
        for (buffer, face) in self.buffers.iter_mut().zip(faces) {
            buffer.clear(face);
        }
    }

    /// Takes the vertices of the patch to render next.
    fn place(&mut self, vertices: &[Point3<f64>], pose: &Pose) {
        self.vertices.clear();
        let in_camera = vertices.iter().map(|v| pose.camera_from_world(v));
        self.vertices.extend(in_camera);
    }

    /// Counts, for each candidate, the pixels in which it is frontmost.
    fn count_in_front(&mut self, patches: &Patches) {
        let Self {
            buffers,
            drawn,
            candidates,
            in_front,
            ..
        } = self;
        in_front.resize(patches.triangle_count(), 0);
        let shown = buffers
            .iter()
            .flat_map(|buffer| buffer.triangles(NOTHING))
            .filter(|&t| t != NOTHING);
        shown.for_each(|t| in_front[t as usize] += 1);
        candidates
            .iter_mut()
            .for_each(|candidate| candidate.in_front = in_front[candidate.triangle as usize]);
        // Usually far fewer than pixels.
        let drawn = drawn
            .iter()
            .flat_map(|&patch| patches.triangle_indices(&patches.patches[patch]));
        drawn.for_each(|&t| in_front[t as usize] = 0);
    }
}

fn is_share(min_share: f64, free: u32, samples: u32) -> bool {
    f64::from(free) >= min_share * f64::from(samples)
}

/// Returns whether at least this share (0 to 1) of the points that are sampled is free. `points`:
/// whether each is free, `None` for one that is not sampled. Stops at the first after which the
/// others cannot change it.
pub(super) fn is_share_free(
    min_share: f64,
    points: impl ExactSizeIterator<Item = Option<bool>>,
) -> bool {
    let (mut samples, mut free) = (0, 0);
    for (left, point) in (0..points.len() as u32).rev().zip(points) {
        samples += u32::from(point.is_some());
        free += u32::from(point == Some(true));
        if samples > 0 && is_share(min_share, free, samples + left) {
            return true;
        }
        if !is_share(min_share, free + left, samples + left) {
            return false;
        }
    }
    false
}

/// A triangle that faces the camera and whose centroid is in the image.
struct Candidate {
    triangle: u32,
    /// Corners in camera coordinates.
    corners: [Point3<f64>; 3],
    /// Pixels that the triangle covers.
    covered: u32,
    /// Pixels in which the triangle is frontmost.
    in_front: u32,
}

impl<'a> Estimator<'a> {
    pub(super) fn new(
        scene: &'a Scene,
        surface: &'a Surface,
        settings: &VisibilitySettings,
        edge_length: f64,
    ) -> Self {
        // Of the scene's edges, not the triangle's: from 0.02 to 0.5 of them, precision and recall
        // change by at most 0.002 on `statue`, `room` and `valley`.
        let length = settings.tolerance_edges * edge_length;
        Self {
            scene,
            surface,
            patches: Patches::new(surface),
            faces: scene
                .cameras
                .iter()
                .map(|c| Face::covering(c, settings.buffer_px))
                .collect(),
            tolerance: Tolerance {
                length,
                depth_share: settings.tolerance_depth,
            },
            near: NEAR_EDGES * edge_length,
            cos2: settings.max_incidence_deg.to_radians().cos().powi(2),
            min_free_share: settings.min_free_share,
        }
    }

    /// Returns the triangles that a view sees, and tells the points that it observes; `None` if it
    /// looks at too many layers.
    pub(super) fn look(
        &self,
        view: ViewIndex,
        observed: &[PointIndex],
        picture: &mut RenderedView,
        observations: &Observations,
    ) -> Option<Vec<u32>> {
        if !self.draw(view, picture) {
            return None;
        }
        let seen = self.visible(view, picture);
        self.observe(view, observed, picture, observations);
        Some(seen)
    }

    /// Renders everything in the view's field and collects the triangles that may be visible;
    /// returns whether all is drawn, which it is up to [`MOST_LAYERS`].
    fn draw(&self, view: ViewIndex, picture: &mut RenderedView) -> bool {
        let (camera, faces) = self.camera(view);
        let pose = &self.scene.view(view).cam_from_world;
        picture.clear(faces);
        let pixels: u64 = faces.iter().map(Face::pixels).sum();
        let mut left = MOST_LAYERS * pixels;
        for (index, patch) in self.patches.patches.iter().enumerate() {
            let centre = pose.camera_from_world(&patch.centre);
            if !faces.iter().any(|face| face.meets(&centre, patch.radius)) {
                continue;
            }
            picture.drawn.push(index);
            picture.place(self.patches.vertices(patch), pose);
            self.draw_patch(patch, faces, picture);
            let drawn: u64 = picture.covered.iter().map(|&n| u64::from(n)).sum();
            let Some(rest) = left.checked_sub(drawn) else {
                return false;
            };
            left = rest;
            self.add_candidates(camera, patch, picture);
        }
        picture.count_in_front(&self.patches);
        true
    }

    /// Adds the triangles of a patch just rendered that may be visible.
    fn add_candidates(&self, camera: &Camera, patch: &Patch, picture: &mut RenderedView) {
        let triangles = self.patches.triangles(patch).zip(&picture.covered);
        for ((triangle, corners), &covered) in triangles {
            let corners = corners.map(|c| picture.vertices[c]);
            if self.may_be_visible(camera, &corners) {
                picture.candidates.push(Candidate {
                    triangle,
                    corners,
                    covered,
                    in_front: 0,
                });
            }
        }
    }

    /// Renders the triangles of a patch, whose vertices are already in `picture`, and counts the
    /// pixels of each.
    fn draw_patch(&self, patch: &Patch, faces: &[Face], picture: &mut RenderedView) {
        let RenderedView {
            buffers,
            vertices,
            projected,
            covered,
            ..
        } = picture;
        covered.clear();
        covered.resize(patch.len(), 0);
        for (face, buffer) in faces.iter().zip(buffers) {
            projected.clear();
            projected.extend(vertices.iter().map(|v| face.project(v)));
            let triangles = self
                .patches
                .triangles(patch)
                .map(|(t, corners)| (t, corners.map(|c| &projected[c])));
            buffer.draw(face, self.near, triangles, covered);
        }
    }

    /// Checks conditions 1 and 2 of method 2; corners in camera coordinates.
    fn may_be_visible(&self, camera: &Camera, [a, b, c]: &[Point3<f64>; 3]) -> bool {
        let everywhere = camera.model() == CameraModel::Equirectangular;
        let centroid = (a.coords + b.coords + c.coords) / 3.0;
        let normal = (b - a).cross(&(c - a));
        let towards = -normal.dot(&centroid);
        let faces_camera = towards > 0.0
            && towards * towards > self.cos2 * normal.norm_squared() * centroid.norm_squared();
        faces_camera
            && (everywhere || a.z.min(b.z).min(c.z) > 0.0)
            && camera
                .project(&centroid.into())
                .is_some_and(|pixel| camera.contains(&pixel))
    }

    /// Returns the candidates that are not occluded (condition 3), ascending.
    fn visible(&self, view: ViewIndex, picture: &mut RenderedView) -> Vec<u32> {
        let mut seen = std::mem::take(&mut picture.seen);
        seen.resize(self.surface.triangles.len().div_ceil(64), 0);
        let mut count = 0;
        for candidate in &picture.candidates {
            let is_free = match candidate.covered {
                ..FEW_PIXELS => self.is_free_at_points(view, picture, candidate),
                covered => self.are_enough(self.free_pixels(view, picture, candidate), covered),
            };
            if is_free {
                seen[candidate.triangle as usize / 64] |= 1 << (candidate.triangle % 64);
                count += 1;
            }
        }
        // Candidates come patch by patch; bits give them in ascending order without a sort.
        let triangles = bits::take(&mut seen, count);
        picture.seen = seen;
        triangles
    }

    fn are_enough(&self, free: u32, samples: u32) -> bool {
        is_share(self.min_free_share, free, samples)
    }

    /// Returns the number of the candidate's pixels that are free. Counts exactly only if needed:
    /// most triangles are frontmost in enough of their pixels and need no second pass.
    fn free_pixels(&self, view: ViewIndex, picture: &RenderedView, candidate: &Candidate) -> u32 {
        if self.are_enough(candidate.in_front, candidate.covered) {
            return candidate.in_front;
        }
        let faces = self.camera(view).1.iter().zip(&picture.buffers);
        faces
            .map(|(face, buffer)| buffer.free(face, &candidate.corners, self.near, self.tolerance))
            .sum()
    }

    /// Returns whether enough of the centroid and the corners are free, among those in the field.
    fn is_free_at_points(
        &self,
        view: ViewIndex,
        picture: &RenderedView,
        candidate: &Candidate,
    ) -> bool {
        let [a, b, c] = candidate.corners;
        let centroid = Point3::from((a.coords + b.coords + c.coords) / 3.0);
        let is_free = |point: Point3<f64>| {
            let mut faces = self.camera(view).1.iter().zip(&picture.buffers);
            let (pixels, own) =
                faces.find_map(|(face, buffer)| buffer.around(face, &point, self.near))?;
            Some(!self.ray_is_blocked(view, &point, candidate.triangle, &pixels, own))
        };
        is_share_free(
            self.min_free_share,
            [centroid, a, b, c].into_iter().map(is_free),
        )
    }

    /// Returns whether a triangle in the pixels around a point is in front of it by more than the
    /// tolerance.
    fn ray_is_blocked(
        &self,
        view: ViewIndex,
        point: &Point3<f64>,
        triangle: u32,
        pixels: &[(u32, f64); 4],
        own: f64,
    ) -> bool {
        let pose = &self.scene.view(view).cam_from_world;
        let blocks = |&(other, front): &(u32, f64)| {
            front > 0.0
                && other != triangle
                && self.tolerance.hides(front, own)
                // The pixel's centre is not on the ray to the point, so the triangle there need not
                // meet it.
                && hit(&self.corners(pose, other), &point.coords)
                    .is_some_and(|share| self.tolerance.hides(own / share, own))
        };
        pixels.iter().any(blocks)
    }

    fn corners(&self, pose: &Pose, triangle: u32) -> [Point3<f64>; 3] {
        self.surface
            .corners(triangle)
            .map(|v| pose.camera_from_world(&v))
    }

    fn camera(&self, view: ViewIndex) -> (&Camera, &[Face]) {
        let camera = self.scene.view(view).camera.index();
        (&self.scene.cameras[camera], &self.faces[camera])
    }

    /// Records which observed points of the view are on the surface and which are behind it.
    fn observe(
        &self,
        view: ViewIndex,
        points: &[PointIndex],
        picture: &RenderedView,
        observations: &Observations,
    ) {
        let pose = &self.scene.view(view).cam_from_world;
        for &p in points {
            let point = pose.camera_from_world(&self.scene.points[p.index()]);
            let mut faces = self.camera(view).1.iter().zip(&picture.buffers);
            let Some((_, front, own)) =
                faces.find_map(|(face, buffer)| buffer.sample(face, &point, self.near))
            else {
                continue;
            };
            if self.tolerance.hides(front, own) {
                observations.hidden[p.index()].fetch_add(1, Ordering::Relaxed);
            } else if !self.tolerance.hides(own, front) {
                observations.on_surface[p.index()].store(true, Ordering::Relaxed);
            }
        }
    }
}

/// Intersects a ray from the origin with a triangle. Returns the position along `ray` as a share of
/// its length, `None` if they don't meet.
pub(super) fn hit([a, b, c]: &[Point3<f64>; 3], ray: &Vector3<f64>) -> Option<f64> {
    let normal = (b - a).cross(&(c - a));
    let share = normal.dot(&a.coords) / normal.dot(ray);
    let sides = [(a, b), (b, c), (c, a)].map(|(p, q)| p.coords.cross(&q.coords).dot(ray));
    // From either side: surface hides what is behind it whichever way it faces.
    let inside = sides.iter().all(|&s| s >= 0.0) || sides.iter().all(|&s| s <= 0.0);
    (inside && share > 0.0).then_some(share)
}

/// By sparse point: whether it is on the surface in any view, and the number of its views in which
/// it is hidden.
pub(super) struct Observations {
    on_surface: Vec<AtomicBool>,
    hidden: Vec<AtomicU32>,
}

impl Observations {
    pub(super) fn new(points: usize) -> Self {
        Self {
            on_surface: (0..points).map(|_| AtomicBool::new(false)).collect(),
            hidden: (0..points).map(|_| AtomicU32::new(0)).collect(),
        }
    }

    pub(super) fn contradictions(self) -> u64 {
        let both = self.on_surface.into_iter().zip(self.hidden);
        both.filter_map(|(on, hidden)| on.into_inner().then_some(u64::from(hidden.into_inner())))
            .sum()
    }
}
