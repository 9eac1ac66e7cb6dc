//! Views through an in-process server: one session renders them, and another one also repairs them.

use std::time::Duration;

use anyhow::{Context, ensure};

use crate::{Place, RepairedWith, SampleRepair, TrainingCamera};
use wildcity_client::protocol::message::{
    Encoding, OnFailure, OpenedRepair, Outputs, ReferenceSource, Repair, Rig, RigChoice,
};
use wildcity_client::protocol::observation::RepairStatus;
use wildcity_client::{Client, ImageView, Observation, Open, Pose};
use wildcity_scene::rig::RigCamera;
use wildcity_twin::store::Version;

/// Time limit for the images of one place: a large model on a processor takes minutes an image.
pub const PLACE_TIMEOUT: Duration = Duration::from_secs(3600);

/// The session that renders, and the session that also repairs.
pub(super) struct ViewSessions {
    plain: Client,
    repaired: Option<Client>,
    backend: String,
    repair: Option<OpenedRepair>,
}

/// One image with its maps.
pub(super) struct Drawn {
    /// Red, green and blue of 8 bits, `[height, width, 3]`.
    pub(super) rendered: Vec<u8>,
    /// The same after the repair, or as rendered if it was not repaired; `None` without a model.
    pub(super) repaired: Option<Vec<u8>>,
    /// Accumulated opacity from 0 to 1, `[height, width]`.
    pub(super) opacity: Vec<f32>,
    pub(super) depth_m: Vec<f32>,
    pub(super) trust: f64,
    pub(super) repair: Option<SampleRepair>,
}

impl ViewSessions {
    /// Opens the sessions with these cameras. `model` is the name of the model and the least trust
    /// of its images.
    pub(super) async fn open(
        url: &str,
        version: &Version,
        cameras: &[TrainingCamera],
        model: Option<(&str, f64)>,
    ) -> anyhow::Result<Self> {
        let rig = Rig {
            name: "augment".to_owned(),
            cameras: cameras.iter().map(wire_camera).collect::<anyhow::Result<_>>()?,
            lidars: Vec::new(),
        };
        let open = |outputs, repair| Open {
            version: Some(version.number),
            rig: Some(RigChoice::Full(rig.clone())),
            outputs,
            repair,
            ..Open::twin(&version.manifest.twin)
        };
        let images = Outputs { encoding: Encoding::Raw, ..Outputs::default() };
        let maps = Outputs { depth: true, opacity: true, trust: Some(true), ..images.clone() };
        let mut plain = client(url).await?;
        let opened = plain.open(open(maps, None)).await?;
        ensure!(
            opened.version_hash == version.hash,
            "twin {} changed while it was opened: try again",
            version.manifest.twin
        );
        let mut sessions = Self { plain, repaired: None, backend: opened.backend, repair: None };
        if let Some((model, at_least)) = model {
            // At any trust that is not below the least one.
            let always = Repair {
                model: model.to_owned(),
                below: Some(1.0),
                above: Some(1.0),
                at_least: Some(at_least),
                per_step: None,
                on_failure: Some(OnFailure::Error),
            };
            let mut repaired = client(url).await?;
            let opened = repaired.open(open(images, Some(always))).await?;
            sessions.repair = opened.repair;
            sessions.repaired = Some(repaired);
        }
        Ok(sessions)
    }

    /// Name of the backend.
    pub(super) fn backend(&self) -> &str {
        &self.backend
    }

    /// The model, as it is recorded.
    pub(super) fn repaired_with(&self) -> Option<RepairedWith> {
        let repair = self.repair.as_ref()?;
        let references = repair.references.map(|source| match source {
            ReferenceSource::Recorded => "recorded".to_owned(),
            ReferenceSource::Rendered => "rendered".to_owned(),
        });
        Some(RepairedWith {
            model: repair.model.clone(),
            version: repair.version.clone(),
            repair_hash: repair.repair_hash.clone(),
            provider: repair.provider.clone(),
            at_least: repair.at_least,
            references,
        })
    }

    /// Renders the images of all cameras at a place.
    pub(super) async fn draw(&mut self, place: &Place) -> anyhow::Result<Vec<Drawn>> {
        let pose = &place.world_from_rig;
        let poses = [Pose { xyz: pose.position_m.to_array(), q: pose.q_wxyz() }];
        let plain = self.plain.observe(&poses);
        let (plain, repaired) = match &mut self.repaired {
            None => (plain.await?, None),
            Some(client) => {
                let (plain, repaired) = tokio::join!(plain, client.observe(&poses));
                (plain?, Some(repaired?))
            }
        };
        let drawn = plain
            .images()
            .enumerate()
            .map(|(at, image)| drawn(image, repaired.as_ref(), at))
            .collect::<anyhow::Result<Vec<Drawn>>>();
        drawn.with_context(|| format!("{} at {} m", place.trajectory, place.station_m))
    }

    pub(super) async fn close(mut self) -> anyhow::Result<()> {
        self.plain.close().await?;
        if let Some(mut repaired) = self.repaired {
            repaired.close().await?;
        }
        Ok(())
    }
}

async fn client(url: &str) -> anyhow::Result<Client> {
    let mut client = Client::connect(url, "wildcity train augment").await?;
    client.set_answer_timeout(PLACE_TIMEOUT + Duration::from_secs(60));
    Ok(client)
}

/// A camera without shutter, exposure and overlay, in the form of the wire. Rig files and the wire
/// have the same JSON.
fn wire_camera(
    training: &TrainingCamera,
) -> anyhow::Result<wildcity_client::protocol::message::RigCamera> {
    let TrainingCamera { name, camera, rig_from_camera } = training;
    let mounted = RigCamera::new(name, *camera, *rig_from_camera);
    Ok(serde_json::from_value(serde_json::to_value(mounted)?)?)
}

/// The image of a camera, with its repaired image from the other observation.
fn drawn(image: ImageView<'_>, repaired: Option<&Observation>, at: usize) -> anyhow::Result<Drawn> {
    let rendered = image.rgb()?.into_owned();
    let trust = image.metadata().trust.context("the image has no trust")?.value;
    let mut drawn = Drawn {
        rendered,
        repaired: None,
        opacity: image.opacity().context("the image has no opacity")?.into_owned(),
        depth_m: image.depth_m().context("the image has no depth")?.into_owned(),
        trust,
        repair: None,
    };
    let Some(repaired) = repaired else { return Ok(drawn) };
    let other = repaired.image(at).context("the repaired image is missing")?;
    let camera = &image.metadata().camera;
    let repair = other.metadata().repair.as_ref().context("the image says nothing of repair")?;
    ensure!(
        repair.rendered_hash == image.metadata().hash,
        "camera {camera}: two sessions rendered different images of one pose"
    );
    let status = match repair.status {
        RepairStatus::Repaired => "repaired",
        RepairStatus::Kept => "kept",
        RepairStatus::Failed => anyhow::bail!("camera {camera}: the model failed"),
    };
    drawn.repaired = Some(other.rgb()?.into_owned());
    let references = repair.references.clone();
    drawn.repair = Some(SampleRepair { status: status.to_owned(), references });
    Ok(drawn)
}
