//! Builds OpenMVS scenes from our views.

use std::collections::BTreeSet;

use nalgebra::Point3;

use crate::{
    backends::Selection,
    io::{
        formats::openmvs::{
            Camera, Image, Mvs, Platform, PlatformPose, Vertex, VertexView, ViewScore,
        },
        project::ImageFolder,
    },
    model::{
        cluster::RankedCluster,
        scene::{Scene, ViewIndex, ViewPoints},
    },
};

/// Least number of vertices per partner: a partner needs three to be a neighbour, the key view more
/// than three in total.
const LEAST_SHARED: usize = 4;

/// Path of the export from the folder in which a map is made.
const FROM_A_TASK: &[u8; 6] = b"../../";

/// Inputs shared by all scenes of an export.
pub struct Builder<'a> {
    scene: &'a Scene,
    images: Option<&'a ImageFolder>,
    points: ViewPoints,
}

/// Depth range of a cluster's sparse points in the key view, scene units.
pub struct DepthRange {
    pub least: f64,
    pub greatest: f64,
}

impl<'a> Builder<'a> {
    pub fn new(selection: &Selection<'a>) -> Self {
        let scene = selection.scene;
        Self {
            scene,
            images: selection.project.images.as_ref(),
            points: scene.view_points(),
        }
    }

    /// Path of a view's image in the folder of the export. OpenMVS chooses a decoder by the
    /// extension.
    pub fn image(&self, view: ViewIndex) -> String {
        let name = self.scene.name(view);
        let named = self.images.map(|images| images.name_of_kind(name));
        format!("images/{}", named.unwrap_or_else(|| name.into()))
    }

    /// Returns a scene with the images in the given order, without points; a list of neighbours
    /// refers to it.
    pub fn images(&self, views: &[ViewIndex]) -> Mvs {
        let mut mvs = Mvs {
            // v2.0 to v2.2 and the builds of ODM refuse version 7.
            version: 6,
            ..Mvs::default()
        };
        for &view in views {
            let index = self.scene.view(view).camera.0;
            let platform = mvs
                .platforms
                .iter()
                .position(|p| p.name == index.to_string().as_bytes());
            let platform = platform.unwrap_or_else(|| {
                mvs.platforms.push(platform_of(self.scene, view));
                mvs.platforms.len() - 1
            });
            let poses = &mut mvs.platforms[platform].poses;
            poses.push(self.pose(view));
            let pose = poses.len() as u32 - 1;
            mvs.images.push(Image {
                name: self.image(view).into_bytes(),
                mask: Vec::new(),
                platform: platform as u32,
                camera: 0,
                pose,
                id: self.scene.view(view).image_id,
                depths: [0.0; 3],
                view_scores: Vec::new(),
            });
        }
        mvs
    }

    /// Returns a scene in which OpenMVS computes only the key view, with all partners: each shared
    /// point becomes a vertex per partner that only the key view and that partner see, so that a
    /// partner has a single neighbour, one less than OpenMVS requires.
    pub fn cluster(&self, cluster: &RankedCluster) -> (Mvs, DepthRange) {
        let mut mvs = self.images(&Vec::from_iter(cluster.views()));
        for image in &mut mvs.images {
            // OpenMVS resolves names from its working folder, which is that of the task.
            image.name.splice(..0, *FROM_A_TASK);
        }
        let mut range = DepthRange {
            least: f64::INFINITY,
            greatest: 0.0,
        };
        for (image, &partner) in (1..).zip(&cluster.partners) {
            let shared = self.shared(cluster.key, partner);
            let times = LEAST_SHARED.div_ceil(shared.len().max(1));
            for (x, depth) in shared.iter().cycle().take(shared.len() * times) {
                range = DepthRange {
                    least: range.least.min(*depth),
                    greatest: range.greatest.max(*depth),
                };
                let views = [0, image].map(|image| VertexView {
                    image,
                    confidence: 1.0,
                });
                mvs.vertices.push(self.vertex(x, &views));
            }
        }
        if cluster.partners.len() == 1 {
            // With two images in the scene one neighbour suffices, also for the partner: a
            // neighbour with a rejected score excludes it.
            mvs.version = 7;
            mvs.images[1].view_scores = vec![dummy(-1.0)];
        }
        (mvs, range)
    }

    /// Returns one scene of all clusters in version 6, which has no view scores: a vertex for each
    /// point that a key view shares with a partner, seen by these two. A partner that isn't a key
    /// view is an image of its own for each key view, so that it has a single neighbour and isn't
    /// computed. A single partner gets one more such image, since OpenMVS requires two neighbours.
    pub fn joint(&self, selection: &Selection, path: impl Fn(&str) -> String) -> Mvs {
        let mut views: Vec<ViewIndex> = selection.clusters.iter().map(|c| c.key).collect();
        let key_of = |view: ViewIndex| {
            (0..)
                .zip(selection.clusters)
                .find_map(|(i, c)| (c.key == view).then_some(i))
        };
        let mut pairs: BTreeSet<[u32; 2]> = BTreeSet::new();
        for (key, cluster) in (0..).zip(selection.clusters) {
            let of_keys = cluster.partners.iter().filter_map(|p| key_of(*p));
            // Each pair of key views once, or its points would be vertices twice.
            pairs.extend(of_keys.map(|other| [key.min(other), key.max(other)]));
            let copied = cluster.partners.iter().filter(|p| key_of(**p).is_none());
            let once_more = cluster
                .partners
                .first()
                .filter(|_| cluster.partners.len() == 1);
            for &partner in copied.chain(once_more) {
                pairs.insert([key, views.len() as u32]);
                views.push(partner);
            }
        }
        let mut mvs = self.images(&views);
        let first_free = self
            .scene
            .views
            .iter()
            .map(|view| view.image_id)
            .max()
            .unwrap_or(0)
            .saturating_add(1);
        for (i, (image, &view)) in mvs.images.iter_mut().zip(&views).enumerate() {
            image.name = path(self.scene.name(view)).into_bytes();
            if let Some(copy) = i.checked_sub(selection.clusters.len()) {
                // The id names the depth map, so a copy must not have that of its original.
                image.id = first_free.saturating_add(copy as u32);
            }
        }
        for pair in pairs {
            let shared = self.shared(views[pair[0] as usize], views[pair[1] as usize]);
            let seen_by = pair.map(|image| VertexView {
                image,
                confidence: 1.0,
            });
            mvs.vertices
                .extend(shared.iter().map(|(x, _)| self.vertex(x, &seen_by)));
        }
        mvs
    }

    fn vertex(&self, x: &Point3<f64>, views: &[VertexView]) -> Vertex {
        Vertex {
            x: x.cast::<f32>().into(),
            views: views.to_vec(),
        }
    }

    /// Returns the points that both observe in front of them, with their depths in the first.
    fn shared(&self, key: ViewIndex, partner: ViewIndex) -> Vec<(Point3<f64>, f64)> {
        let depth = |view: ViewIndex, x: &Point3<f64>| {
            self.scene.view(view).cam_from_world.camera_from_world(x).z
        };
        let other = self.points.observed_by(partner);
        let both = self
            .points
            .observed_by(key)
            .iter()
            .filter(|p| other.binary_search(p).is_ok());
        let points = both
            .map(|p| self.scene.points[p.index()])
            .filter(|x| depth(partner, x) > 0.0);
        points
            .map(|x| (x, depth(key, &x)))
            .filter(|(_, z)| *z > 0.0)
            .collect()
    }

    fn pose(&self, view: ViewIndex) -> PlatformPose {
        let pose = &self.scene.view(view).cam_from_world;
        // A matrix is stored by columns, and OpenMVS reads rotations by rows.
        let r = pose.rotation.matrix().transpose();
        PlatformPose {
            r: r.as_slice().try_into().expect("nine numbers"),
            c: pose.centre().into(),
        }
    }
}

/// A neighbour with a score that OpenMVS rejects; the index must be valid in the scene.
fn dummy(score: f32) -> ViewScore {
    ViewScore {
        index: 0,
        points: 9,
        scale: 1.0,
        angle: 0.2,
        area: 0.5,
        score,
    }
}

/// Returns a platform with the view's camera; pixel centres are integers in OpenMVS.
fn platform_of(scene: &Scene, view: ViewIndex) -> Platform {
    let camera = scene.camera_of(view);
    let (f, c) = camera.pinhole_part();
    let k = [f.x, 0.0, c.x - 0.5, 0.0, f.y, c.y - 0.5, 0.0, 0.0, 1.0];
    let (width, height) = (camera.width, camera.height);
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let camera = Camera {
        name: Vec::new(),
        band: Vec::new(),
        width,
        height,
        k,
        r: identity,
        c: [0.0; 3],
    };
    Platform {
        name: scene.view(view).camera.0.to_string().into_bytes(),
        cameras: vec![camera],
        poses: Vec::new(),
    }
}
