use super::*;
use proptest::prelude::*;

/// One camera per model with typical parameters.
fn cameras() -> Vec<Camera> {
    let extra: [&[f64]; 18] = [
        &[],
        &[],
        &[-0.02],
        &[-0.03, 0.008],
        &[-0.03, 0.01, 0.0005, -0.0007],
        &[0.02, -0.006, 0.002, -0.001],
        &[-0.05, 0.02, 0.0004, -0.0006, 0.001, 0.01, -0.004, 0.0008],
        &[0.6],
        &[0.01],
        &[0.01, -0.004],
        &[
            0.02, -0.005, 0.0003, -0.0004, 0.001, -0.0005, 0.0006, -0.0007,
        ],
        &[
            0.02, -0.005, 0.002, -0.0008, 0.0002, -0.0001, 0.0003, -0.0004, 0.0005, -0.0006,
            0.0002, -0.0003,
        ],
        &[-0.05],
        &[0.05],
        &[],
        &[],
        &[0.6, 1.1],
        &[],
    ];
    let focal = [751.0, 752.5];
    CameraModel::all()
        .map(|model| {
            let mut params = match model {
                CameraModel::Equirectangular => vec![1000.0, 500.0],
                _ => [&focal[..model.focal_length_count()], &[501.0, 374.0]].concat(),
            };
            params.extend(extra[model as usize]);
            Camera::new(1, model, 1000, 750, params).unwrap()
        })
        .collect()
}

#[test]
fn models_have_colmaps_numbers_and_names() {
    for (id, model) in CameraModel::all().enumerate() {
        assert_eq!(model.id() as usize, id);
        assert_eq!(CameraModel::from_id(id as u32), Some(model));
        assert_eq!(CameraModel::from_name(model.name()), Some(model));
    }
    assert_eq!(CameraModel::from_id(18), None);
    assert_eq!(CameraModel::from_name("PINHOLES"), None);
}

#[test]
fn zero_distortion_is_none_where_the_model_is_a_pinhole_with_distortion() {
    let points = [[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-2.0, 1.5, 4.0]].map(Point3::from);
    let mut pinholes = Vec::new();
    for camera in cameras() {
        let distorted = camera.clone().without_zero_distortion();
        assert_eq!(distorted, camera, "{}", camera.model().name());
        let intrinsics = camera.model().focal_length_count() + 2;
        let mut params = camera.params().to_vec();
        if camera.model() != CameraModel::Equirectangular {
            // As rounding leaves it.
            params[intrinsics..].fill(1e-18);
        }
        let zero = Camera::new(1, camera.model(), 1000, 750, params).unwrap();
        let plain = zero.clone().without_zero_distortion();
        for point in &points {
            let [with, without] = [&zero, &plain].map(|camera| camera.project(point).unwrap());
            assert!((with - without).norm() < 1e-9, "{}", camera.model().name());
        }
        if plain != zero {
            assert_eq!((plain.width, plain.height), (1000, 750));
            pinholes.push(camera.model().name());
        }
        assert_eq!(plain.is_pinhole(), plain != zero || zero.is_pinhole());
    }
    assert_eq!(
        pinholes,
        [
            "SIMPLE_RADIAL",
            "RADIAL",
            "OPENCV",
            "FULL_OPENCV",
            "FOV",
            "SIMPLE_DIVISION",
            "DIVISION",
            "EUCM"
        ]
    );
}

#[test]
fn projections_agree_with_pycolmap() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../fixtures/formats/camera_models/projections.json"
    );
    let text = std::fs::read_to_string(path).unwrap();
    let all: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
    assert_eq!(all.len(), 18);
    for (key, entry) in &all {
        let name = key
            .split_once("models/")
            .unwrap()
            .1
            .split_once('_')
            .unwrap()
            .1;
        let model = CameraModel::from_name(name).unwrap();
        let number = |v: &serde_json::Value| v.as_f64().unwrap();
        let camera = &entry["camera"];
        let params = camera["params"]
            .as_array()
            .unwrap()
            .iter()
            .map(number)
            .collect();
        let size = |key: &str| camera[key].as_u64().unwrap();
        let camera = Camera::new(1, model, size("width"), size("height"), params).unwrap();
        for pair in entry["project"].as_array().unwrap() {
            let x = Point3::from_slice(
                &pair[0]
                    .as_array()
                    .unwrap()
                    .iter()
                    .map(number)
                    .collect::<Vec<_>>(),
            );
            let expected = pair[1]
                .as_array()
                .map(|p| Point2::new(number(&p[0]), number(&p[1])));
            match (camera.project(&x), expected) {
                (Some(found), Some(expected)) => {
                    let tolerance = if camera.is_pinhole() { 1e-10 } else { 1e-9 };
                    assert!(
                        (found - expected).norm() < tolerance,
                        "{name} {x}: {found} instead of {expected}"
                    );
                    assert_eq!(camera.project_beyond_field(&x), Some(found));
                }
                (found, expected) => assert_eq!(found, expected, "{name} {x}"),
            }
        }
    }
}

/// Jacobian of the projection by central differences.
fn differences(camera: &Camera, x: &Point3<f64>) -> Option<Matrix2x3<f64>> {
    let mut jacobian = Matrix2x3::zeros();
    for axis in 0..3 {
        let mut step = Vector3::zeros();
        step[axis] = 1e-6 * x.coords.norm();
        let (up, down) = (camera.project(&(x + step))?, camera.project(&(x - step))?);
        jacobian.set_column(axis, &((up - down) / (2.0 * step[axis])));
    }
    Some(jacobian)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn jacobian_is_the_derivative(u in -0.6..0.6f64, v in -0.5..0.5f64, depth in 0.1..50.0f64, m in 0usize..18) {
        let camera = &cameras()[m];
        let x = Point3::new(u * depth, v * depth, depth);
        let (pixel, jacobian) = camera.project_with_jacobian(&x).unwrap();
        prop_assert_eq!(Some(pixel), camera.project(&x));
        let expected = differences(camera, &x).unwrap();
        let error = (jacobian - expected).norm() / expected.norm();
        prop_assert!(error < 1e-6, "{} at {x}: {error}", camera.model().name());
        // A step along the ray does not move the pixel.
        prop_assert!((jacobian * x.coords).norm() < 1e-9 * 750.0);
    }

    #[test]
    fn ray_undoes_projection(u in -1.0..1.0f64, v in -1.0..1.0f64, depth in 0.1..50.0f64, m in 0usize..18) {
        let camera = &cameras()[m];
        let x = Point3::new(u * depth, v * depth, depth);
        let Some(pixel) = camera.project(&x) else { return Ok(()) };
        let ray = camera.ray(&pixel).unwrap();
        prop_assert!((ray.into_inner() - x.coords.normalize()).norm() < 1e-9, "{}", camera.model().name());
    }

    #[test]
    fn projection_undoes_ray(x in 0.0..1000.0f64, y in 0.0..500.0f64, m in 0usize..18) {
        let camera = &cameras()[m];
        let ray = camera.ray(&Point2::new(x, y)).unwrap();
        let pixel = camera.project(&Point3::from(ray.into_inner() * 7.0)).unwrap();
        prop_assert!((pixel - Point2::new(x, y)).norm() < 1e-8, "{}", camera.model().name());
    }

    /// For any parameters: no panic, the ray projects to the pixel, and with purely radial
    /// distortion it passes through the point.
    #[test]
    fn any_parameters_are_safe(
        m in 0u32..18,
        extra in prop::collection::vec(prop_oneof![-2.0..2.0f64, -1e6..1e6f64, Just(0.0)], 12),
        x in prop::array::uniform3(-3.0..3.0f64),
    ) {
        let model = CameraModel::from_id(m).unwrap();
        let mut params = vec![500.0; model.parameter_count()];
        let fixed = model.focal_length_count() + 2;
        let tail = params.len() - fixed.min(params.len());
        params[fixed..].copy_from_slice(&extra[..tail]);
        let camera = Camera::new(0, model, 1000, 1000, params).unwrap();
        let point = Point3::from(x);
        let Some((pixel, _)) = camera.project_with_jacobian(&point) else { return Ok(()) };
        let Some(ray) = camera.ray(&pixel) else { return Ok(()) };
        let off = ray.cross(&point.coords.normalize()).norm();
        let again = camera.project_beyond_field(&Point3::from(ray.into_inner())).unwrap();
        let radial = !matches!(m, 4 | 6 | 10 | 11);
        prop_assert!(off < 1e-3 || !radial, "{} {:?} {point}: {off}", model.name(), camera.params());
        let miss = (again - pixel).norm() / (1.0 + pixel.coords.norm());
        prop_assert!(miss < 1e-5, "{} {:?} {point}: {pixel} {again}", model.name(), camera.params());
    }
}

#[test]
fn jacobian_on_the_axis() {
    for camera in cameras() {
        let x = Point3::new(0.0, 0.0, 3.0);
        let (_, jacobian) = camera.project_with_jacobian(&x).unwrap();
        let error = (jacobian - differences(&camera, &x).unwrap()).norm();
        assert!(error < 1e-4, "{}: {error}", camera.model().name());
    }
}

#[test]
fn strong_distortion_limits_the_field() {
    // r (1 - 0.3 r²) turns back at r = 1/√0.9.
    let turn = (1.0f64 / 0.9).sqrt();
    let camera = Camera::new(
        1,
        CameraModel::SimpleRadial,
        1000,
        1000,
        vec![500.0, 500.0, 500.0, -0.3],
    )
    .unwrap();
    assert!(
        camera
            .project(&Point3::new(turn - 1e-6, 0.0, 1.0))
            .is_some()
    );
    assert!(
        camera
            .project(&Point3::new(turn + 1e-6, 0.0, 1.0))
            .is_none()
    );
    assert!(
        camera
            .project_with_jacobian(&Point3::new(turn + 1e-6, 0.0, 1.0))
            .is_none()
    );
    assert!(
        camera
            .project_beyond_field(&Point3::new(turn + 1e-6, 0.0, 1.0))
            .is_some()
    );
    let farthest = 500.0 * turn * (1.0 - 0.3 * turn * turn);
    assert!(
        camera
            .ray(&Point2::new(500.0 + farthest - 1e-6, 500.0))
            .is_some()
    );
    assert!(
        camera
            .ray(&Point2::new(500.0 + farthest + 1e-6, 500.0))
            .is_none()
    );
}

#[test]
fn points_behind_the_camera_have_no_projection() {
    for camera in cameras() {
        let projected = camera.project(&Point3::new(0.1, 0.2, -1.0));
        let sees_behind = matches!(
            camera.model(),
            CameraModel::Equirectangular | CameraModel::SimpleDivision
        );
        assert_eq!(
            projected.is_some(),
            sees_behind,
            "{}",
            camera.model().name()
        );
        assert_eq!(camera.project(&Point3::origin()), None);
        assert_eq!(
            camera
                .project(&Point3::new(f64::NAN, 0.0, 1.0))
                .filter(|p| p.x.is_finite()),
            None
        );
    }
}

#[test]
fn equirectangular_projects_every_direction() {
    let camera = Camera::new(
        1,
        CameraModel::Equirectangular,
        1000,
        500,
        vec![1000.0, 500.0],
    )
    .unwrap();
    for x in [
        Point3::new(-0.3, 0.1, -2.0),
        Point3::new(1.0, 0.0, 0.0),
        Point3::new(0.1, -5.0, 0.1),
    ] {
        let pixel = camera.project(&x).unwrap();
        let ray = camera.ray(&pixel).unwrap();
        assert!((ray.into_inner() - x.coords.normalize()).norm() < 1e-12);
    }
    assert_eq!(
        camera.project(&Point3::new(1.0, 0.0, 0.0)),
        Some(Point2::new(750.0, 250.0))
    );
}

#[test]
fn bad_parameters_are_refused() {
    let camera = |model, params: &[f64]| Camera::new(1, model, 10, 10, params.to_vec());
    assert!(matches!(
        camera(CameraModel::Pinhole, &[1.0]),
        Err(CameraError::ParameterCount {
            expected: 4,
            found: 1,
            ..
        })
    ));
    assert!(matches!(
        camera(CameraModel::SimplePinhole, &[1.0, f64::NAN, 1.0]),
        Err(CameraError::NotFinite { index: 1, .. })
    ));
    assert_eq!(
        camera(CameraModel::SimplePinhole, &[0.0, 1.0, 1.0]),
        Err(CameraError::FocalLength(0.0))
    );
    assert_eq!(
        camera(CameraModel::Equirectangular, &[4.0, -1.0]),
        Err(CameraError::FocalLength(-1.0))
    );
    let empty = Camera::new(
        1,
        CameraModel::SimplePinhole,
        0,
        1 << 40,
        vec![1.0, 1.0, 1.0],
    );
    assert_eq!(
        empty,
        Err(CameraError::ImageSize {
            width: 0,
            height: 1 << 40
        })
    );
}
