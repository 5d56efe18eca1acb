//! The finished part of a plan, and the camera and pose of its views when it was made.

use std::collections::BTreeMap;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{
    base::bounded,
    model::{
        camera::{Camera, CameraModel},
        scene::{Pose, Scene, ViewIndex},
    },
};

/// Most views and view clusters of a plan that is read back, as of a model in a foreign format.
pub const MOST_VIEWS: usize = 1 << 18;

/// What is known of the finished depth maps of a plan.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FinishedMaps {
    /// Depth maps that no longer fit the model, by key view.
    pub outdated: Vec<OutdatedMap>,
    /// A sentence for each depth map that cannot be read, and for all of another size.
    pub unreadable: Vec<String>,
    /// For depth maps made with an earlier model, the views of their clusters in that model, by key
    /// view, then by name.
    pub made_with: BTreeMap<String, BTreeMap<String, PlannedView>>,
    /// BLAKE3 of each outdated depth map, by key view, to tell it from a new one of the same view.
    pub outdated_files: BTreeMap<String, String>,
}

/// A finished depth map whose views have moved since it was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct OutdatedMap {
    /// The key view.
    pub key: String,
    /// The view of its cluster that moved most.
    pub view: String,
    /// Displacement of the depth map's points in that view, px of the model's image; null where the
    /// view is no longer in the model.
    pub moved_px: Option<f64>,
}

/// `viewrank/planned_views.json`: the views as planned, so that a later plan can tell which depth
/// maps still fit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlannedViews {
    pub version: u32,
    /// By name.
    #[serde(deserialize_with = "bounded::map::<_, _, MOST_VIEWS>")]
    pub views: BTreeMap<String, PlannedView>,
    /// [`FinishedMaps::made_with`].
    #[serde(deserialize_with = "bounded::map::<_, _, MOST_VIEWS>")]
    pub made_with: BTreeMap<String, BTreeMap<String, PlannedView>>,
    /// [`FinishedMaps::outdated_files`].
    #[serde(deserialize_with = "bounded::map::<_, _, MOST_VIEWS>")]
    pub outdated_files: BTreeMap<String, String>,
}

/// Camera and pose of a view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannedView {
    camera: PlannedCamera,
    /// cam_from_world, quaternion w, x, y, z.
    rotation: [f64; 4],
    /// cam_from_world, scene units.
    translation: [f64; 3],
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct PlannedCamera {
    /// COLMAP's name of the camera model.
    model: String,
    width: u32,
    height: u32,
    #[serde(deserialize_with = "bounded::list::<_, _, 100>")]
    params: Vec<f64>,
}

impl PlannedViews {
    pub fn new(scene: &Scene, finished: &FinishedMaps) -> Self {
        let view = |view| (scene.name(view).to_owned(), PlannedView::new(scene, view));
        Self {
            version: 1,
            views: scene.view_indices().map(view).collect(),
            made_with: finished.made_with.clone(),
            outdated_files: finished.outdated_files.clone(),
        }
    }
}

impl PlannedView {
    pub fn new(scene: &Scene, view: ViewIndex) -> Self {
        let (camera, pose) = (scene.camera_of(view), &scene.view(view).cam_from_world);
        let q = UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self {
            camera: PlannedCamera {
                model: camera.model().name().into(),
                width: camera.width,
                height: camera.height,
                params: camera.params().to_vec(),
            },
            rotation: [q.w, q.i, q.j, q.k],
            translation: pose.translation.into(),
        }
    }

    /// The recorded camera and pose; `None` where the record is invalid.
    pub fn camera_and_pose(&self) -> Option<(Camera, Pose)> {
        let PlannedCamera {
            model,
            width,
            height,
            params,
        } = &self.camera;
        let model = CameraModel::from_name(model)?;
        // Any id will do: the camera is only projected through.
        let camera =
            Camera::new(1, model, (*width).into(), (*height).into(), params.clone()).ok()?;
        let [w, x, y, z] = self.rotation;
        // The file may be damaged or edited: a quaternion of length 0 is no rotation.
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), f64::MIN_POSITIVE)?
            .to_rotation_matrix();
        Some((
            camera,
            Pose {
                rotation,
                translation: Vector3::from(self.translation),
            },
        ))
    }
}
