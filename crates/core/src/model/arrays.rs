//! Scenes from plain arrays, for programs that hold their model in memory.

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

use super::{
    camera::{Camera, CameraError, CameraModel},
    scene::{CameraIndex, Pose, Scene, View, ViewIndex},
};
use crate::base::error::{Advice, Hint};

/// Largest entry of `R Rᵀ - I` of a rotation; rotations in f32 pass.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// A sparse model in plain arrays; views in any order.
#[derive(Clone, Debug, Default)]
pub struct SceneArrays {
    pub cameras: Vec<Intrinsics>,
    /// Names of the views, unique: image paths relative to the image folder, `/` between folders.
    pub names: Vec<String>,
    /// Camera of each view, an index into `cameras`.
    pub camera: Vec<usize>,
    /// World to camera, `[R | t]` row by row: x right, y down, z forward.
    pub cam_from_world: Vec<[f64; 12]>,
    /// Sparse points, world coordinates, scene units.
    pub points: Vec<[f64; 3]>,
    /// Observations in any order: indices into `points` and `names`.
    pub observations: Vec<[usize; 2]>,
    /// Image position of each observation, pixels, the centre of the first pixel at (0.5, 0.5).
    /// Empty: the projections of the points.
    pub pixels: Vec<[f64; 2]>,
}

/// Intrinsics as COLMAP writes them.
#[derive(Clone, Debug, PartialEq)]
pub struct Intrinsics {
    /// Name of the camera model, such as "PINHOLE".
    pub model: String,
    /// Image size, pixels.
    pub width: u64,
    pub height: u64,
    /// Parameters in COLMAP's order for the model.
    pub params: Vec<f64>,
}

/// Arrays that are no scene.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ArraysError {
    #[error("cannot use {array}: it has {found} rows, names has {expected}")]
    Length {
        array: &'static str,
        expected: usize,
        found: usize,
    },
    #[error("cannot use pixels: it has {found} rows, observations has {expected}")]
    Pixels { expected: usize, found: usize },
    #[error("cannot use {array}: row {row} is {index}, past the end of {of} ({length})")]
    Index {
        array: &'static str,
        row: usize,
        index: usize,
        of: &'static str,
        length: usize,
    },
    #[error("cannot use {array}: row {row} is not finite")]
    NotFinite { array: &'static str, row: usize },
    #[error("cannot use cam_from_world: row {row} ({name}) is no rotation")]
    Rotation { row: usize, name: String },
    #[error("cannot use names: \"{0}\" occurs twice")]
    SameName(String),
    #[error("cannot use cameras: row {row} has the unknown model \"{model}\"")]
    CameraModel { row: usize, model: String },
    #[error("cannot use cameras: row {row}: {error}")]
    Camera { row: usize, error: CameraError },
}

impl Hint for ArraysError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Length { .. } => "give one row per view".into(),
            Self::Pixels { .. } => "give one row per observation, or none at all".into(),
            Self::Index { .. } => "count from 0".into(),
            Self::NotFinite { .. } => "remove rows with NaN and infinity".into(),
            Self::Rotation { .. } => {
                "give [R | t] from world to camera, R orthonormal with determinant 1".into()
            }
            Self::SameName(_) => "give each view the path of its image".into(),
            Self::CameraModel { .. } => format!(
                "take one of {}",
                CameraModel::all()
                    .map(CameraModel::name)
                    .collect::<Vec<_>>()
                    .join(", ")
            )
            .into(),
            Self::Camera { .. } => "give the parameters in COLMAP's order for the model".into(),
        })
    }

    fn is_usage(&self) -> bool {
        true
    }
}

impl Scene {
    /// Makes a scene of plain arrays. Views are sorted by name; ids are positions in the arrays,
    /// from 1.
    ///
    /// # Errors
    /// Arrays of different lengths, indices past the end, values that are not finite, poses that
    /// are no rotation, names or intrinsics that are invalid.
    pub fn from_arrays(arrays: &SceneArrays) -> Result<Self, ArraysError> {
        arrays.check_lengths()?;
        let cameras = arrays.cameras()?;
        let order = arrays.rows_by_name()?;
        let views = order
            .iter()
            .map(|&row| arrays.view(row))
            .collect::<Result<_, _>>()?;
        let mut view_of_row = vec![ViewIndex(0); order.len()];
        for (v, &row) in (0..).zip(&order) {
            view_of_row[row] = ViewIndex(v);
        }
        let scene = Self {
            cameras,
            views,
            points: arrays.points()?,
            point_ids: (1..=arrays.points.len() as u64).collect(),
            colours: vec![[128; 3]; arrays.points.len()],
            track_offsets: vec![0; arrays.points.len() + 1],
            ..Self::default()
        };
        arrays.tracks(scene, &view_of_row)
    }
}

impl SceneArrays {
    fn check_lengths(&self) -> Result<(), ArraysError> {
        let expected = self.names.len();
        for (array, found) in [
            ("camera", self.camera.len()),
            ("cam_from_world", self.cam_from_world.len()),
        ] {
            if found != expected {
                return Err(ArraysError::Length {
                    array,
                    expected,
                    found,
                });
            }
        }
        match self.pixels.len() {
            found if found != 0 && found != self.observations.len() => Err(ArraysError::Pixels {
                expected: self.observations.len(),
                found,
            }),
            _ => Ok(()),
        }
    }

    fn cameras(&self) -> Result<Vec<Camera>, ArraysError> {
        let camera = |(row, given): (usize, &Intrinsics)| {
            let model =
                CameraModel::from_name(&given.model).ok_or_else(|| ArraysError::CameraModel {
                    row,
                    model: given.model.clone(),
                })?;
            Camera::new(
                row as u32 + 1,
                model,
                given.width,
                given.height,
                given.params.clone(),
            )
            .map_err(|error| ArraysError::Camera { row, error })
        };
        self.cameras.iter().enumerate().map(camera).collect()
    }

    /// Returns the rows of the views in the order of their names, which are unique.
    fn rows_by_name(&self) -> Result<Vec<usize>, ArraysError> {
        let names = &self.names;
        let mut rows: Vec<usize> = (0..names.len()).collect();
        rows.sort_by(|&a, &b| names[a].cmp(&names[b]));
        let mut neighbours = rows.windows(2);
        match neighbours.find(|pair| names[pair[0]] == names[pair[1]]) {
            Some(same) => Err(ArraysError::SameName(names[same[0]].clone())),
            None => Ok(rows),
        }
    }

    fn points(&self) -> Result<Vec<Point3<f64>>, ArraysError> {
        let is_finite = |x: &[f64; 3]| x.iter().all(|v| v.is_finite());
        match self.points.iter().position(|x| !is_finite(x)) {
            Some(row) => Err(ArraysError::NotFinite {
                array: "points",
                row,
            }),
            None => Ok(self.points.iter().map(|&x| Point3::from(x)).collect()),
        }
    }

    fn view(&self, row: usize) -> Result<View, ArraysError> {
        let camera = self.camera[row];
        check_index("camera", row, camera, "cameras", self.cameras.len())?;
        Ok(View {
            name: self.names[row].clone(),
            image_id: row as u32 + 1,
            file_position: row as u32,
            camera: CameraIndex(camera as u32),
            cam_from_world: self.pose(row)?,
        })
    }

    fn pose(&self, row: usize) -> Result<Pose, ArraysError> {
        let pose = &self.cam_from_world[row];
        if pose.iter().any(|v| !v.is_finite()) {
            return Err(ArraysError::NotFinite {
                array: "cam_from_world",
                row,
            });
        }
        let rotation = Matrix3::from_fn(|r, c| pose[4 * r + c]);
        let error = (rotation * rotation.transpose() - Matrix3::identity()).amax();
        // A reflection has R Rᵀ = I, too.
        if error > ROTATION_TOLERANCE || rotation.determinant() < 0.0 {
            return Err(ArraysError::Rotation {
                row,
                name: self.names[row].clone(),
            });
        }
        Ok(Pose {
            rotation: Rotation3::from_matrix_unchecked(rotation),
            translation: Vector3::new(pose[3], pose[7], pose[11]),
        })
    }

    /// Sorts the observations into tracks, by view within a track. Those whose pixel is to be
    /// projected and cannot be are left out.
    fn tracks(&self, mut scene: Scene, view_of_row: &[ViewIndex]) -> Result<Scene, ArraysError> {
        let mut observed = Vec::with_capacity(self.observations.len());
        for (row, &[point, view]) in self.observations.iter().enumerate() {
            self.check_observation(row)?;
            let view = view_of_row[view];
            let pixel = self.pixel(row, &scene, view, point)?;
            observed.extend(pixel.map(|pixel| (point, view, row, pixel)));
        }
        // By row last: a view may observe a point twice.
        observed.sort_unstable_by_key(|&(point, view, row, _)| (point, view, row));
        for (point, view, _, pixel) in observed {
            scene.track_offsets[point + 1] += 1;
            scene.track_views.push(view);
            scene.track_pixels.push(pixel);
        }
        (0..self.points.len()).for_each(|p| scene.track_offsets[p + 1] += scene.track_offsets[p]);
        Ok(scene)
    }

    fn check_observation(&self, row: usize) -> Result<(), ArraysError> {
        let [point, view] = self.observations[row];
        check_index("observations", row, point, "points", self.points.len())?;
        check_index("observations", row, view, "names", self.names.len())
    }

    /// Returns the pixel of an observation, the projection of its point where none is given; `None`
    /// if that does not exist.
    fn pixel(
        &self,
        row: usize,
        scene: &Scene,
        view: ViewIndex,
        point: usize,
    ) -> Result<Option<[f64; 2]>, ArraysError> {
        let pixel = match self.pixels.get(row) {
            Some(pixel) => Some(*pixel),
            None => {
                let pose = &scene.view(view).cam_from_world;
                let x_cam = pose.camera_from_world(&scene.points[point]);
                let pixel = scene.camera_of(view).project(&x_cam);
                pixel.map(|pixel| [pixel.x, pixel.y])
            }
        };
        match pixel {
            Some(pixel) if pixel.iter().any(|v| !v.is_finite()) => Err(ArraysError::NotFinite {
                array: "pixels",
                row,
            }),
            pixel => Ok(pixel),
        }
    }
}

fn check_index(
    array: &'static str,
    row: usize,
    index: usize,
    of: &'static str,
    length: usize,
) -> Result<(), ArraysError> {
    if index < length {
        Ok(())
    } else {
        Err(ArraysError::Index {
            array,
            row,
            index,
            of,
            length,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_views() -> SceneArrays {
        let pose = |x: f64| [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        SceneArrays {
            cameras: vec![Intrinsics {
                model: "PINHOLE".into(),
                width: 100,
                height: 80,
                params: vec![90.0, 90.0, 50.0, 40.0],
            }],
            names: vec!["b.jpg".into(), "a.jpg".into()],
            camera: vec![0, 0],
            cam_from_world: vec![pose(0.0), pose(-1.0)],
            points: vec![[0.0, 0.0, 9.0], [0.5, 0.0, 9.0]],
            observations: vec![[1, 0], [0, 1], [0, 0], [1, 1]],
            pixels: Vec::new(),
        }
    }

    #[test]
    fn views_are_sorted_and_observations_become_tracks() {
        let scene = Scene::from_arrays(&two_views()).unwrap();
        assert_eq!(
            scene
                .views
                .iter()
                .map(|view| view.name.as_str())
                .collect::<Vec<_>>(),
            ["a.jpg", "b.jpg"]
        );
        assert_eq!(scene.track_offsets, [0, 2, 4]);
        assert_eq!(scene.track_views, [0, 1, 0, 1].map(ViewIndex));
        // The point at the optical axis of b.jpg is 1 unit to the left of that of a.jpg: 90 px / 9
        // units.
        assert_eq!(scene.track_pixels[..2], [[40.0, 40.0], [50.0, 40.0]]);
    }

    #[test]
    fn arrays_that_contradict_each_other_are_refused() {
        let refused = |change: fn(&mut SceneArrays)| {
            let mut arrays = two_views();
            change(&mut arrays);
            Scene::from_arrays(&arrays).unwrap_err()
        };
        assert!(matches!(
            refused(|a| a.camera.truncate(1)),
            ArraysError::Length {
                array: "camera",
                ..
            }
        ));
        assert!(matches!(
            refused(|a| a.camera[1] = 3),
            ArraysError::Index { of: "cameras", .. }
        ));
        assert!(matches!(
            refused(|a| a.observations[0] = [2, 0]),
            ArraysError::Index {
                row: 0,
                of: "points",
                ..
            }
        ));
        assert!(matches!(
            refused(|a| a.names[0] = "a.jpg".into()),
            ArraysError::SameName(_)
        ));
        assert!(matches!(
            refused(|a| a.cam_from_world[0][0] = 2.0),
            ArraysError::Rotation { row: 0, .. }
        ));
        assert!(matches!(
            refused(|a| a.points[1][2] = f64::NAN),
            ArraysError::NotFinite {
                array: "points",
                row: 1
            }
        ));
        assert!(matches!(
            refused(|a| a.pixels.push([0.0; 2])),
            ArraysError::Pixels { .. }
        ));
        assert!(matches!(
            refused(|a| a.cameras[0].model = "LENS".into()),
            ArraysError::CameraModel { .. }
        ));
        assert!(matches!(
            refused(|a| _ = a.cameras[0].params.pop()),
            ArraysError::Camera { .. }
        ));
    }
}
