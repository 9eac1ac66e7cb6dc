//! Observations: the header of a safetensors file, and the metadata in it.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::fault::Fault;
use wildcity_protocol::message::RigCamera;
use wildcity_protocol::observation::{
    self as wire, Actor, Ego, Event, Geo, Image, NavigationCommand, ObservationMetadata, Residency,
    Route, Stage, Sweep, Timings, Trust,
};
use wildcity_render::FIRST_ACTOR_INSTANCE;
use wildcity_scene::ActorBox;
use wildcity_scene::geo::{GeoPoint, GeoPose};
use wildcity_scene::geometry::camera::Pinhole;
use wildcity_session::{
    DType, Episode, EpisodeTraffic, EventKind, HEADER_PREFIX_BYTES, PastImageInfo, Session,
    SweepInfo, TensorKind,
};
use wildcity_sim::scenario;

use super::answer::{camera, encoding, pose, text};
use super::sensors::image_sensor;

/// Completes an observation: writes the header, which has the names of the tensors and the
/// metadata, into the space that is reserved for it in the buffer.
pub(crate) fn observation(
    seq: u64,
    session: &Session,
    mut frame: wildcity_session::Observation,
) -> Result<wildcity_session::Observation, Fault> {
    // Computed once: each image has up to six tensors, and an entry in the metadata.
    let image_names = image_names(session, &frame);
    let mut header = Header { tensors: BTreeMap::new(), metadata: BTreeMap::new() };
    for tensor in &frame.tensors {
        let name = match tensor.kind {
            TensorKind::HistoryXyz => "ego.history_xyz".to_owned(),
            TensorKind::HistoryRotation => "ego.history_rot".to_owned(),
            TensorKind::Imu => "sensor.imu".to_owned(),
            TensorKind::WheelSpeed => "sensor.wheel_speed".to_owned(),
            TensorKind::Points(sweep) => sweep_tensor(session, &frame, sweep, "points"),
            TensorKind::Intensity(sweep) => sweep_tensor(session, &frame, sweep, "intensity"),
            TensorKind::Rows(sweep) => sweep_tensor(session, &frame, sweep, "row"),
            TensorKind::Columns(sweep) => sweep_tensor(session, &frame, sweep, "column"),
            TensorKind::PointInstances(sweep) => sweep_tensor(session, &frame, sweep, "instance"),
            TensorKind::PointClasses(sweep) => sweep_tensor(session, &frame, sweep, "class"),
            TensorKind::Depth(image) => format!("{}/depth", image_names[image]),
            TensorKind::Opacity(image) => format!("{}/opacity", image_names[image]),
            TensorKind::Normals(image) => format!("{}/normals", image_names[image]),
            TensorKind::Instances(image) => format!("{}/instances", image_names[image]),
            TensorKind::Semantics(image) => format!("{}/semantics", image_names[image]),
            TensorKind::Rgb(image) => format!("{}/rgb", image_names[image]),
            TensorKind::PastRgb(image) => past_tensor(session, &frame.history[image]),
        };
        let dtype = match tensor.dtype {
            DType::F32 => "F32",
            DType::U8 => "U8",
            DType::U16 => "U16",
        };
        let data_offsets = [tensor.bytes.start, tensor.bytes.end];
        // The tensors are in the buffer already, at offsets that do not depend on the header.
        header.tensors.insert(name, TensorInfo { dtype, shape: &tensor.shape, data_offsets });
    }
    let observation = text(&metadata(seq, session, &frame, &image_names)?)?;
    header.metadata.insert("observation", observation);
    let header = text(&header)?;

    // A safetensors file begins with the length of its header; the header is padded with spaces, so
    // that the tensors begin at a multiple of 8.
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
    // One pose, as in every step, needs no number in its names.
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

/// Name of a tensor of a sweep, by the sweep's index.
fn sweep_tensor(
    session: &Session,
    frame: &wildcity_session::Observation,
    sweep: usize,
    tensor: &str,
) -> String {
    let name = &session.lidars()[frame.sweeps[sweep].lidar].name;
    format!("lidar/{name}/{tensor}")
}

fn sweep(session: &Session, info: &SweepInfo) -> Sweep {
    let mounted = &session.lidars()[info.lidar];
    let first_us = mounted.lidar.age_us(0).round() as i64;
    Sweep {
        lidar: mounted.name.clone(),
        start_us: info.time_us - first_us,
        end_us: info.time_us,
        rows: mounted.lidar.rows() as u64,
        columns: mounted.lidar.columns() as u64,
        returns: info.returns as u64,
        lidar_to_rig: pose(&mounted.rig_from_lidar),
        hash: info.hash.to_hex().to_string(),
    }
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
        // The time of an image is the end of its exposure; a global shutter has no duration.
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
            repair: None,
            sensor: None,
        }
    };
    let drawn = |(drawn, name): (&wildcity_session::ImageInfo, &String)| Image {
        pose: drawn.pose as u64,
        trust: drawn.trust.map(trust),
        repair: drawn.repair.as_ref().map(repair),
        sensor: drawn.sensor.map(image_sensor),
        ..image(drawn.camera, format!("{name}/rgb"), drawn.time_us, &drawn.hash)
    };
    let past = |past: &PastImageInfo| Image {
        back: past.back as u64,
        trust: past.trust.map(trust),
        repair: past.repair.as_ref().map(repair),
        sensor: past.sensor.map(image_sensor),
        ..image(past.camera, past_tensor(session, past), past.time_us, &past.hash)
    };
    let timings = &frame.timings;
    let ms = |duration: std::time::Duration| duration.as_secs_f64() * 1e3;
    let stage = |&(name, ms): &(&str, f64)| Stage { name: name.to_owned(), ms };
    let anchor = version.manifest.geo.as_ref();
    // Only twins with a place on the earth have one.
    let located = anchor
        .map(|anchor| anchor.locate(&episode.world_from_rig()))
        .transpose()
        .map_err(|error| Fault::Internal(error.to_string()))?;
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
        newer_version: session.newer_version(),
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
        sweeps: frame.sweeps.iter().map(|info| sweep(session, info)).collect(),
        history: frame.history.iter().map(past).collect(),
        events: events(session),
        route: session.traffic().and_then(|traffic| route(traffic, episode)),
        actors: session.traffic().filter(|_| session.reports_actors()).map(actors),
        timings: Timings {
            queue_ms: ms(timings.queue),
            render_ms: ms(timings.render),
            encode_ms: ms(timings.encode),
            // Absent without a model, so that 0 means a repair that took no time.
            repair_ms: session.repair().map(|_| ms(timings.repair)),
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

fn events(session: &Session) -> Vec<Event> {
    let traffic = session.traffic();
    let name_of = |actor: u16| Some(traffic?.specs().get(usize::from(actor))?.name.clone());
    let event = |event: &wildcity_session::Event| {
        let mut told = Event {
            time_us: event.time_us,
            kind: wire::EventKind::End,
            actor: None,
            name: None,
            at_fault: None,
            impact: None,
        };
        match &event.kind {
            EventKind::Contact(contact) => {
                told.kind = wire::EventKind::Contact;
                told.actor = name_of(contact.actor);
                // A contact that is there at the start comes from no driving, so that it is not
                // told.
                told.at_fault = (!contact.at_start).then_some(contact.ego_at_fault);
                told.impact = Some(contact.impact_mps);
            }
            EventKind::StaticContact { impact_mps, .. } => {
                told.kind = wire::EventKind::Contact;
                // What does not move cannot be at fault.
                told.at_fault = Some(true);
                told.impact = Some(*impact_mps);
            }
            EventKind::Trigger { actor, trigger } => {
                told.kind = wire::EventKind::Trigger;
                told.actor = name_of(*actor);
                let name = traffic.map_or("", |traffic| traffic.trigger_name(*actor, *trigger));
                told.name = (!name.is_empty()).then(|| name.to_owned());
            }
            EventKind::Appeared { actor } => {
                told.kind = wire::EventKind::Appeared;
                told.actor = name_of(*actor);
            }
            EventKind::Left { actor } => {
                told.kind = wire::EventKind::Left;
                told.actor = name_of(*actor);
            }
            EventKind::OffModel { .. } => told.kind = wire::EventKind::OffModel,
            EventKind::End(reason) => told.name = Some(reason.name().to_owned()),
        }
        told
    };
    session.events().iter().map(event).collect()
}

fn route(traffic: &EpisodeTraffic, episode: &Episode) -> Option<Route> {
    let view = traffic.route(episode.ego())?;
    let (route, progress) = traffic.route_progress()?;
    let command = match view.command {
        scenario::NavigationCommand::Left => NavigationCommand::Left,
        scenario::NavigationCommand::Right => NavigationCommand::Right,
        scenario::NavigationCommand::Straight => NavigationCommand::Straight,
    };
    Some(Route {
        points: view.points_m.iter().map(|point_m| point_m.to_array()).collect(),
        command,
        text: view.text,
        station_m: progress.station_m,
        off_m: progress.off_m,
        length_m: route.course.length_m(),
    })
}

fn actors(traffic: &EpisodeTraffic) -> Vec<Actor> {
    // Actors that have not appeared yet, or have left, keep their state but are not drawn.
    let present = traffic.states().iter().filter(|state| state.present);
    present
        .map(|state| {
            let spec = &traffic.specs()[usize::from(state.index)];
            let ActorBox { length_m, width_m, height_m } = spec.box_;
            Actor {
                name: spec.name.clone(),
                kind: spec.class.name().to_owned(),
                // The value of the actor's pixels in the map of instances. An index is below 256,
                // so the sum fits.
                instance: FIRST_ACTOR_INSTANCE + state.index,
                size: [length_m, width_m, height_m],
                pose: pose(&state.world_from_actor),
                velocity: state.velocity_mps.to_array(),
                yaw_rate: state.yaw_rate_radps,
            }
        })
        .collect()
}

fn repair(repair: &wildcity_session::ImageRepair) -> wire::ImageRepair {
    use wire::{RepairFailure, RepairStatus};

    let wildcity_session::ImageRepair { status, rendered_hash, references } = repair;
    let (status, failure) = match *status {
        wildcity_session::RepairStatus::Kept => (RepairStatus::Kept, None),
        wildcity_session::RepairStatus::Repaired => (RepairStatus::Repaired, None),
        wildcity_session::RepairStatus::Failed(failure) => {
            let failure = match failure {
                wildcity_session::RepairFailure::TimedOut => RepairFailure::TimedOut,
                wildcity_session::RepairFailure::NotFinite => RepairFailure::NotFinite,
                wildcity_session::RepairFailure::Withdrawn => RepairFailure::Withdrawn,
                wildcity_session::RepairFailure::Other => RepairFailure::Other,
            };
            (RepairStatus::Failed, Some(failure))
        }
    };
    wire::ImageRepair {
        status,
        rendered_hash: rendered_hash.to_hex().to_string(),
        failure,
        references: references.clone(),
    }
}

fn trust(trust: wildcity_session::Trust) -> Trust {
    let wildcity_session::Trust { value, distance_m, angle_rad, low_coverage, outside } = trust;
    Trust { value, distance_m, angle_rad, low_coverage, outside }
}
