//! OpenMVS's `scene.mvs` in its interface form ("MVSI", versions 1 to 7), defined in
//! libs/MVS/Interface.h.
//!
//! Little-endian, no padding; `str` = u64 length and bytes, `arr(T)` = u64 count and elements,
//! matrices f64 row-major:
//!
//! ```text
//! header    "MVSI"  u32 version  u32 0
//! scene     arr(platform) arr(image) arr(vertex) arr(normal) arr(colour)
//!           v>0: arr(line) arr(normal) arr(colour)   v>1: f64[16] transform   v>5: f64[9] f64[3] f64[3] region of interest
//! platform  str name  arr(camera)  arr(pose)
//! camera    str name  [v>3: str band]  [v>0: u32 width u32 height]  f64[9] K  f64[9] R  f64[3] C
//! pose      f64[9] R  f64[3] C
//! image     str name  [v>4: str mask]  u32 platform u32 camera u32 pose  [v>2: u32 ID]
//!           [v>6: f32 min depth, mean, max  arr(view score)]
//! view score  u32 index  u32 points  f32 scale  f32 angle  f32 area  f32 score
//! vertex    f32[3] X  arr(view)     view := u32 image index  f32 confidence
//! line      f32[3] f32[3] arr(view)     normal := f32[3]     colour := u8[3] blue green red
//! ```
//!
//! Pixel centres are integers: cx is COLMAP's minus 0.5. World to camera: `x = R (X - C)`; a
//! camera's R and C are relative to its platform's pose. The file has no measured pixels.

mod read;
mod scene;
mod write;

/// Pose index of an uncalibrated image.
pub const NO_POSE: u32 = u32::MAX;

/// ID of an image without an ID; its index is used instead.
pub const NO_ID: u32 = u32::MAX;

/// Newest supported version.
pub const NEWEST: u32 = 7;

/// Contents of the file; fields that its version lacks have default values.
#[derive(Clone, Debug, PartialEq)]
pub struct Mvs {
    pub version: u32,
    pub platforms: Vec<Platform>,
    pub images: Vec<Image>,
    pub vertices: Vec<Vertex>,
    pub normals: Vec<[f32; 3]>,
    /// Blue, green, red.
    pub colours: Vec<[u8; 3]>,
    pub lines: Vec<Line>,
    pub line_normals: Vec<[f32; 3]>,
    pub line_colours: Vec<[u8; 3]>,
    /// Row-major; OpenMVS stores it but never applies it.
    pub transform: [f64; 16],
    /// Rotation, minimum and maximum corner; no region if a minimum exceeds its maximum.
    pub region: [f64; 15],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Platform {
    pub name: Vec<u8>,
    pub cameras: Vec<Camera>,
    pub poses: Vec<PlatformPose>,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Camera {
    pub name: Vec<u8>,
    pub band: Vec<u8>,
    /// Width, pixels; 0 if K is normalised by the longer side of the image.
    pub width: u32,
    pub height: u32,
    pub k: [f64; 9],
    pub r: [f64; 9],
    pub c: [f64; 3],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlatformPose {
    pub r: [f64; 9],
    pub c: [f64; 3],
}

#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Path of the image file, relative to OpenMVS's working folder or absolute.
    pub name: Vec<u8>,
    pub mask: Vec<u8>,
    pub platform: u32,
    pub camera: u32,
    /// [`NO_POSE`] if uncalibrated.
    pub pose: u32,
    /// Number in the name of the depth map; the index of the image if the file has none (before
    /// version 3, or [`NO_ID`]).
    pub id: u32,
    /// Minimum, mean and maximum depth.
    pub depths: [f32; 3],
    pub view_scores: Vec<ViewScore>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewScore {
    /// Index of the neighbour in `images`.
    pub index: u32,
    pub points: u32,
    pub scale: f32,
    /// Radians.
    pub angle: f32,
    pub area: f32,
    pub score: f32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Vertex {
    pub x: [f32; 3],
    pub views: Vec<VertexView>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VertexView {
    /// Index in `images`.
    pub image: u32,
    pub confidence: f32,
}

#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    pub ends: [[f32; 3]; 2],
    pub views: Vec<VertexView>,
}

impl Default for Mvs {
    /// Makes an empty scene of the newest version, without transform or region.
    fn default() -> Self {
        let mut transform = [0.0; 16];
        (0..4).for_each(|i| transform[5 * i] = 1.0);
        let mut region = [0.0; 15];
        (0..3).for_each(|i| region[4 * i] = 1.0);
        region[9..12].fill(f64::from(f32::MAX));
        region[12..].fill(-f64::from(f32::MAX));
        Self {
            version: NEWEST,
            platforms: Vec::new(),
            images: Vec::new(),
            vertices: Vec::new(),
            normals: Vec::new(),
            colours: Vec::new(),
            lines: Vec::new(),
            line_normals: Vec::new(),
            line_colours: Vec::new(),
            transform,
            region,
        }
    }
}

impl Mvs {
    /// Returns a copy with cameras and images only.
    pub fn without_points(self) -> Self {
        let Self {
            version,
            platforms,
            images,
            transform,
            region,
            ..
        } = self;
        Self {
            version,
            platforms,
            images,
            transform,
            region,
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::formats::{Place, Problem};

    /// One camera, and three images that all observe four points.
    fn small(version: u32) -> Mvs {
        let camera = Camera {
            name: b"c".into(),
            width: 4,
            height: 3,
            k: [1.0; 9],
            ..Camera::default()
        };
        let poses = (0..3)
            .map(|i| PlatformPose {
                r: [f64::from(i); 9],
                c: [0.5; 3],
            })
            .collect();
        let score = |index| ViewScore {
            index,
            points: 9,
            scale: 1.0,
            angle: 0.2,
            area: 0.5,
            score: 3.0,
        };
        let image = |i: u32| Image {
            name: format!("images/{i}.jpg").into_bytes(),
            mask: Vec::new(),
            platform: 0,
            camera: 0,
            pose: i,
            id: if version > 2 { 40 + i } else { i },
            depths: if version > 6 {
                [1.0, 2.0, 3.0]
            } else {
                [0.0; 3]
            },
            view_scores: if version > 6 {
                vec![score((i + 1) % 3), score((i + 2) % 3)]
            } else {
                Vec::new()
            },
        };
        let views = (0..3)
            .map(|image| VertexView {
                image,
                confidence: 1.0,
            })
            .collect::<Vec<_>>();
        Mvs {
            version,
            platforms: vec![Platform {
                name: Vec::new(),
                cameras: vec![camera],
                poses,
            }],
            images: (0..3).map(image).collect(),
            vertices: (0..4)
                .map(|i| Vertex {
                    x: [i as f32; 3],
                    views: views.clone(),
                })
                .collect(),
            colours: vec![[1, 2, 3]; 4],
            ..Mvs::default()
        }
    }

    #[test]
    fn every_version_round_trips() {
        for version in 1..=NEWEST {
            let bytes = small(version).write();
            let read = Mvs::read(&bytes).unwrap();
            assert_eq!(read, small(version), "version {version}");
            assert_eq!(read.write(), bytes);
        }
    }

    /// Like OpenMVS when it loads a scene.
    #[test]
    fn an_image_without_id_has_its_index() {
        for version in 1..=NEWEST {
            let mut scene = small(version);
            (scene.images[0].id, scene.images[2].id) = (NO_ID, NO_ID);
            let ids: Vec<u32> = Mvs::read(&scene.write())
                .unwrap()
                .images
                .iter()
                .map(|image| image.id)
                .collect();
            assert_eq!(
                ids,
                [0, if version > 2 { 41 } else { 1 }, 2],
                "version {version}"
            );
        }
    }

    /// Sizes measured with OpenMVS's own header, compiled for each version.
    #[test]
    fn file_sizes_of_all_versions_agree_with_openmvs() {
        let sizes: Vec<usize> = (1..=NEWEST).map(|v| small(v).write().len()).collect();
        let grown: Vec<usize> = sizes.windows(2).map(|w| w[1] - w[0]).collect();
        assert_eq!(grown, [128, 12, 8, 24, 120, 204]);
    }

    #[test]
    fn every_truncation_is_an_error() {
        let bytes = small(7).write();
        for length in 0..bytes.len() {
            assert!(Mvs::read(&bytes[..length]).is_err(), "{length} bytes");
        }
        assert!(
            Mvs::read(&[&bytes[..], &[0]].concat())
                .is_err_and(|e| e.to_string().contains("1 bytes follow"))
        );
    }

    #[test]
    fn a_newer_version_is_refused() {
        let mut bytes = small(7).write();
        bytes[4] = 8;
        assert!(Mvs::read(&bytes).is_err_and(|e| e.to_string().contains("version 8")));
    }

    #[test]
    fn a_huge_count_allocates_nothing() {
        let mut bytes = b"MVSI\x07\0\0\0\0\0\0\0".to_vec();
        bytes.extend_from_slice(&(1u64 << 60).to_le_bytes());
        let problem = Problem::Count {
            what: "platforms",
            count: 1 << 60,
            room: 0,
        };
        assert_eq!(Mvs::read(&bytes), Err(problem.at(Place::Byte(20))));
    }

    #[test]
    fn the_error_names_an_index_out_of_range() {
        let mut scene = small(7);
        scene.images[1].pose = 3;
        assert_eq!(
            Mvs::read(&scene.write()).unwrap_err().to_string(),
            "whole file (image 1): reference to pose 3, which is not in the model"
        );
        let mut scene = small(7);
        scene.vertices[2].views[0].image = 3;
        assert_eq!(
            Mvs::read(&scene.write()).unwrap_err().to_string(),
            "whole file (vertex 2): reference to image 3, which is not in the model"
        );
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..400), version in 0u8..9) {
            let _ = Mvs::read(&bytes);
            bytes.splice(0..0, [b'M', b'V', b'S', b'I', version, 0, 0, 0, 0, 0, 0, 0]);
            let _ = Mvs::read(&bytes);
        }

        #[test]
        fn no_changed_byte_makes_it_panic(at in 12usize..1300, value in any::<u8>()) {
            let mut bytes = small(7).write();
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
            let _ = Mvs::read(&bytes);
        }
    }
}
