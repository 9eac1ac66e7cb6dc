//! Observations: the header of a safetensors file, and the metadata in it.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::fault::Fault;
use wildcity_protocol::message::RigCamera;
use wildcity_protocol::observation::{
    Ego, Geo, Image, ObservationMetadata, Residency, Stage, Timings, Trust,
};
use wildcity_scene::geo::{GeoPoint, GeoPose};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_session::{DType, HEADER_PREFIX_BYTES, PastImageInfo, Session, TensorKind};

use super::answer::{camera, encoding, pose, text};

/// Completes an observation: writes the header, which has the names of the tensors and the metadata, into
/// the space that is reserved for it in the buffer.
pub(crate) fn observation(
    seq: u64,
    session: &Session,
    mut frame: wildcity_session::Observation,
) -> Result<wildcity_session::Observation, Fault> {
    let image_names = image_names(session, &frame);
    let mut header = Header { tensors: BTreeMap::new(), metadata: BTreeMap::new() };
    for tensor in &frame.tensors {
        let name = match tensor.kind {
            TensorKind::HistoryXyz => "ego.history_xyz".to_owned(),
            TensorKind::HistoryRotation => "ego.history_rot".to_owned(),
            TensorKind::Depth(image) => format!("{}/depth", image_names[image]),
            TensorKind::Opacity(image) => format!("{}/opacity", image_names[image]),
            TensorKind::Normals(image) => format!("{}/normals", image_names[image]),
            TensorKind::Rgb(image) => format!("{}/rgb", image_names[image]),
            TensorKind::PastRgb(image) => past_tensor(session, &frame.history[image]),
        };
        let dtype = match tensor.dtype {
            DType::F32 => "F32",
            DType::U8 => "U8",
        };
        let data_offsets = [tensor.bytes.start, tensor.bytes.end];
        header.tensors.insert(name, TensorInfo { dtype, shape: &tensor.shape, data_offsets });
    }
    let observation = text(&metadata(seq, session, &frame, &image_names)?)?;
    header.metadata.insert("observation", observation);
    let header = text(&header)?;

    // A safetensors file begins with the length of its header; the header is padded with spaces, so that the
    // tensors begin at a multiple of 8.
    let padded = header.len().next_multiple_of(8);
    let Some(room) = frame.buffer.header_mut(HEADER_PREFIX_BYTES + padded) else {
        return Err(Fault::Internal(format!("there is no room for a header of {padded} bytes")));
    };
    let (prefix, room) = room.split_at_mut(HEADER_PREFIX_BYTES);
    prefix.copy_from_slice(&(padded as u64).to_le_bytes());
    let (written, padding) = room.split_at_mut(header.len());
    written.copy_from_slice(header.as_bytes());
    padding.fill(b' ');
    Ok(frame)
}

#[derive(Serialize)]
struct Header<'a> {
    #[serde(rename = "__metadata__")]
    metadata: BTreeMap<&'static str, String>,
    #[serde(flatten)]
    tensors: BTreeMap<String, TensorInfo<'a>>,
}

#[derive(Serialize)]
struct TensorInfo<'a> {
    dtype: &'static str,
    shape: &'a [usize],
    data_offsets: [usize; 2],
}

/// Prefix of the names of each image's tensors: without the `/rgb` at the end.
fn image_names(session: &Session, frame: &wildcity_session::Observation) -> Vec<String> {
    let several = frame.images.iter().any(|image| image.pose > 0);
    let name = |image: &wildcity_session::ImageInfo| {
        let camera = &session.cameras()[image.camera].name;
        if several {
            format!("pose/{}/camera/{camera}", image.pose)
        } else {
            format!("camera/{camera}")
        }
    };
    frame.images.iter().map(name).collect()
}

fn past_tensor(session: &Session, past: &PastImageInfo) -> String {
    format!("camera/{}/history/{}/rgb", session.cameras()[past.camera].name, past.back)
}

fn metadata(
    seq: u64,
    session: &Session,
    frame: &wildcity_session::Observation,
    image_names: &[String],
) -> Result<ObservationMetadata, Fault> {
    let episode = session.episode();
    let version = &session.resident().version;
    let time_us = episode.time_us();
    let (encoding, _) = encoding(session.encoding());
    // The fields that entries of `images` and of `history` have in common.
    let image = |index: usize, tensor: String, time_us: i64, hash: &blake3::Hash| {
        let mounted = &session.cameras()[index];
        let Pinhole { fx, fy, cx, cy } = mounted.camera.pinhole;
        let RigCamera { name: camera, width, height, lens, windshield, camera_to_rig, .. } =
            camera(mounted);
        let exposed_us = mounted.shutter.map_or(0, |shutter| shutter.duration_us);
        Image {
            camera,
            index: index as u64,
            pose: 0,
            back: 0,
            tensor,
            encoding,
            width,
            height,
            fx,
            fy,
            cx,
            cy,
            lens,
            windshield,
            seen: session.visible_share(index),
            camera_to_rig,
            shutter_start_us: time_us - exposed_us,
            shutter_end_us: time_us,
            hash: hash.to_hex().to_string(),
            trust: None,
        }
    };
    let drawn = |(drawn, name): (&wildcity_session::ImageInfo, &String)| Image {
        pose: drawn.pose as u64,
        trust: drawn.trust.map(trust),
        ..image(drawn.camera, format!("{name}/rgb"), drawn.time_us, &drawn.hash)
    };
    let past = |past: &PastImageInfo| Image {
        back: past.back as u64,
        trust: past.trust.map(trust),
        ..image(past.camera, past_tensor(session, past), past.time_us, &past.hash)
    };
    let timings = &frame.timings;
    let ms = |duration: std::time::Duration| duration.as_secs_f64() * 1e3;
    let stage = |&(name, ms): &(&str, f64)| Stage { name: name.to_owned(), ms };
    let anchor = version.manifest.geo.as_ref();
    let located = anchor.map(|anchor| anchor.locate(&episode.world_from_rig())).transpose();
    let located = located.map_err(|error| Fault::Internal(error.to_string()))?;
    Ok(ObservationMetadata {
        seq,
        step: episode.step(),
        time_us,
        session: session.name().to_owned(),
        seed: episode.seed(),
        terminated: episode.terminated(),
        twin: version.manifest.twin.clone(),
        version: version.number,
        version_hash: version.hash.clone(),
        profile_hash: session.profile_hash().to_hex().to_string(),
        backend: session.backend().to_owned(),
        frame_hash: frame.frame_hash.to_hex().to_string(),
        ego: Ego {
            pose: pose(&episode.world_from_rig()),
            velocity: episode.ego().velocity_m_s().to_array(),
            acceleration: episode.ego().acceleration_m_s2().to_array(),
            yaw_rate: episode.ego().yaw_rate_rad_s(),
            steering: episode.ego().steering_rad(),
            history_count: frame.history_count as u64,
        },
        geo: located.map(geo),
        images: frame.images.iter().zip(image_names).map(drawn).collect(),
        history: frame.history.iter().map(past).collect(),
        timings: Timings {
            queue_ms: ms(timings.queue),
            render_ms: ms(timings.render),
            encode_ms: ms(timings.encode),
            stages_ms: timings.stages_ms.iter().map(stage).collect(),
        },
        residency: Residency {
            held_bytes: frame.residency.held_bytes,
            limit_bytes: frame.residency.limit_bytes,
            waited_for: frame.residency.waited_for as u64,
            waited_us: frame.residency.waited.as_micros() as u64,
        },
    })
}

fn geo(located: GeoPose) -> Geo {
    let GeoPoint { latitude_deg, longitude_deg, altitude_m } = located.point;
    Geo {
        latitude: latitude_deg,
        longitude: longitude_deg,
        altitude: altitude_m,
        heading: located.heading_deg,
    }
}

fn trust(trust: wildcity_session::Trust) -> Trust {
    let wildcity_session::Trust { value, distance_m, angle_rad, low_coverage, outside } = trust;
    Trust { value, distance_m, angle_rad, low_coverage, outside }
}
