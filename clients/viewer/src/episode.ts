// Seek through recorded episodes: the pictures are rendered again, and their hashes compared with the record.

import { Client } from "./client";
import { hasModifier } from "./controls";
import { el, fixed, messageOf, showStatus, showTitle } from "./dom";
import { MapView } from "./map";
import { Mosaic } from "./mosaic";
import type { Page } from "./page";
import { clamp, length, subtract } from "./pose";
import { load } from "./record";
import type { RecordedFrame, Recording } from "./record";
import type { Metadata, TwinInfo } from "./messages";
import { get } from "./server";
import { viewerSession } from "./session";

/** One episode: its pictures, rendered by a session of its own. */
class Player {
  readonly mosaic = new Mosaic();
  readonly verdict = el("span.verdict");
  readonly element: HTMLElement;
  readonly recording: Recording;
  private client: Client | undefined;
  private version = 0;
  private wanted: RecordedFrame | undefined;
  private works = false;
  private ended = false;

  /** The bar has the name of a single episode. */
  constructor(recording: Recording, isNamed: boolean) {
    this.recording = recording;
    const { name, twin, outcome, frames } = recording;
    const end = outcome?.replaceAll("_", " ") ?? "no end";
    const named = isNamed ? [el("b", {}, name), " · "] : [];
    const title = el("p.title", {}, ...named, `${twin} · ${frames.length} ${frames.length === 1 ? "frame" : "frames"} · ${end} `, this.verdict);
    this.element = el("div.player", {}, title, this.mosaic.element);
  }

  async end(): Promise<void> {
    this.ended = true;
    await this.client?.end();
  }

  /** The last frame at a time. */
  frameAt(timeUs: number): RecordedFrame | undefined {
    const { frames } = this.recording;
    return frames.findLast((frame) => frame.time_us <= timeUs) ?? frames[0];
  }

  /** Shows the frame at a time, and calls `shown`. While one is rendered only the newest request counts. */
  async seek(timeUs: number, shown: (metadata: Metadata) => void): Promise<void> {
    const frame = this.frameAt(timeUs);
    if (!frame || frame === this.wanted) return;
    this.wanted = frame;
    if (this.works) return;
    this.works = true;
    try {
      let done: RecordedFrame | undefined;
      while (this.wanted !== done && !this.ended) {
        done = this.wanted;
        shown(await this.render(done!));
      }
    } finally {
      this.works = false;
    }
  }

  /** The speed between a frame and the one before it, in m/s. */
  private speedAt(frame: RecordedFrame): number {
    const { frames } = this.recording;
    const at = frames.indexOf(frame);
    const [before, after] = [frames[Math.max(0, at - 1)]!, frames[Math.max(1, at)] ?? frame];
    const seconds = (after.time_us - before.time_us) * 1e-6;
    return seconds > 0 ? length(subtract(after.pose.xyz, before.pose.xyz)) / seconds : 0;
  }

  private async render(frame: RecordedFrame): Promise<Metadata> {
    const { twin, cameras, profile } = this.recording;
    this.client ??= new Client();
    await this.client.connect();
    if (this.version !== frame.version) {
      if (this.version) await this.client.close();
      this.version = frame.version;
      const outputs = { encoding: "jpeg", quality: 88 };
      await this.client.open({
        twin, profile, outputs, version: frame.version, session: viewerSession("seek"), record: false, rig: { name: "recorded", cameras },
      });
    }
    const observation = await this.client.observation({ type: "observe", poses: [frame.pose] });
    const compared = observation.metadata.images.filter(({ camera }) => frame.images.has(camera));
    const equal = compared.filter(({ camera, hash }) => frame.images.get(camera) === hash);
    this.mosaic.annotate(({ camera, hash }) => {
      const recorded = frame.images.get(camera);
      return recorded === undefined ? "not recorded" : recorded === hash ? "" : "differs";
    });
    // The rows of a rolling shutter depend on the motion, which a pose alone does not have.
    const reasons = [cameras.some(({ shutter }) => shutter) ? "has no rolling shutter" : "", this.recording.drawsActors ? "draws no actors" : ""];
    const reason = reasons.filter(Boolean).join(" and ");
    const isSame = equal.length === compared.length && compared.length > 0;
    this.verdict.className = isSame ? "verdict good" : compared.length === 0 || reason ? "verdict" : "verdict bad";
    const other = compared.length - equal.length;
    const images = compared.length === 1 ? "image" : "images";
    this.verdict.textContent = compared.length === 0 ? "no images recorded here"
      : isSame ? `${equal.length} of ${compared.length} ${images} ${equal.length === 1 ? "has" : "have"} the recorded hash`
      : `${other} of ${compared.length} ${images} ${other === 1 ? "differs" : "differ"}${reason && `: this page ${reason}`}`;
    this.mosaic.drives(frame.time_us, this.speedAt(frame));
    await this.mosaic.show(observation);
    this.element.dataset.same = String(isSame);
    this.element.dataset.timeUs = String(frame.time_us);
    const { ego } = observation.metadata;
    return { ...observation.metadata, step: frame.step, time_us: frame.time_us, actors: frame.actors, ego: { ...ego, pose: frame.pose } };
  }
}

export class EpisodePage implements Page {
  readonly element = el("div.episode");
  private readonly map = new MapView();
  private readonly slider = el("input", { type: "range", min: "0", max: "0", step: "1", value: "0", ariaLabel: "time" });
  private readonly time = el("output");
  private readonly marks = el("div.marks");
  private readonly play = el("button", { type: "button", title: "Space" }, "Play");
  private readonly events = el("ol.events");
  private readonly abort = new AbortController();
  private players: Player[] = [];
  private times: number[] = [];
  private isPlaying = false;
  private ended = false;

  constructor(names: string[]) {
    showTitle(el("b", {}, names.join(" and ")), " · recorded");
    this.slider.addEventListener("input", () => void this.seek());
    this.play.addEventListener("click", () => this.setPlaying(!this.isPlaying));
    addEventListener("keydown", (event) => this.key(event), { signal: this.abort.signal });
    void this.begin(names);
  }

  async end(): Promise<void> {
    this.ended = true;
    this.isPlaying = false;
    this.abort.abort();
    await Promise.all(this.players.map((player) => player.end()));
  }

  private key(event: KeyboardEvent): void {
    if (hasModifier(event)) return;
    const step = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 }[event.code];
    if (event.code === "Space") this.setPlaying(!this.isPlaying);
    else if (step !== undefined) this.to(Number(this.slider.value) + step);
    else return;
    event.preventDefault();
  }

  private async begin(names: string[]): Promise<void> {
    try {
      showStatus("loading");
      const recordings = await Promise.all(names.map(load));
      if (this.ended) return;
      const empty = recordings.find(({ frames }) => frames.length === 0);
      if (empty) throw new Error(`${empty.name} has no frames`);
      this.players = recordings.map((recording) => new Player(recording, recordings.length > 1));
      this.times = [...new Set(recordings.flatMap(({ frames }) => frames.map((frame) => frame.time_us)))].sort((a, b) => a - b);
      this.slider.max = String(this.times.length - 1);
      const [first] = recordings;
      const { trajectories } = await get<TwinInfo>(`v1/twins/${first!.twin}`);
      await this.map.load(first!.twin, first!.frames[0]!.version, trajectories.map(({ name }) => name));
      if (this.ended) return;
      for (const [at, { frames }] of recordings.entries()) {
        this.map.path(frames.map(({ pose }) => pose.xyz), at === 0 ? "accent" : "warm");
      }
      this.map.lanes(recordings.flatMap(({ lanes }) => lanes));
      this.showEvents(recordings);
      const line = el("div.line", {}, this.play, el("div.track", {}, this.slider, this.marks), this.time);
      this.element.append(
        el("div.players", {}, ...this.players.map(({ element }) => element)),
        el("div.below", {}, line, el("div.beside", {}, this.map.element, this.events)));
      showStatus("");
      await this.seek();
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }

  private showEvents(recordings: Recording[]): void {
    const events = recordings.flatMap((recording) => recording.events.map((event) => ({ ...event, name: recording.name })));
    const last = this.times.length - 1 || 1;
    const indexOf = (timeUs: number): number => Math.max(0, this.times.findLastIndex((time) => time <= timeUs));
    this.marks.replaceChildren(...events.map((event) => {
      const mark = el(event.isBad ? "i.bad" : "i", { title: event.text });
      mark.style.left = `${(indexOf(event.time_us) / last) * 100}%`;
      return mark;
    }));
    const items = events.sort((a, b) => a.time_us - b.time_us).map((event) => {
      const button = el("button", { type: "button" }, `${fixed(event.time_us * 1e-6, 1)} s  ${event.text}`);
      button.addEventListener("click", () => this.to(indexOf(event.time_us)));
      return el(event.isBad ? "li.bad" : "li", {}, button);
    });
    this.events.replaceChildren(...(items.length ? items : [el("li.dim", {}, "no contacts and no events")]));
  }

  private setPlaying(playing: boolean): void {
    this.isPlaying = playing && !this.ended;
    this.play.textContent = this.isPlaying ? "Stop" : "Play";
    if (this.isPlaying) void this.run();
  }

  /** Plays as fast as the recorded time, or as fast as the server renders. */
  private async run(): Promise<void> {
    while (this.isPlaying) {
      const at = Number(this.slider.value);
      if (at >= this.times.length - 1) return this.setPlaying(false);
      const begun = performance.now();
      this.slider.value = String(at + 1);
      await this.seek();
      const due = (this.times[at + 1]! - this.times[at]!) / 1000 - (performance.now() - begun);
      await new Promise((resolve) => setTimeout(resolve, Math.max(0, due)));
    }
  }

  private to(at: number): void {
    this.slider.value = String(clamp(at, 0, this.times.length - 1));
    void this.seek();
  }

  private async seek(): Promise<void> {
    const timeUs = this.times[Number(this.slider.value)] ?? 0;
    this.time.textContent = `${fixed(timeUs * 1e-6, 2)} s`;
    this.time.dataset.timeUs = String(timeUs);
    try {
      await Promise.all(this.players.map((player, at) => player.seek(timeUs, (metadata) => this.map.at(metadata, at))));
    } catch (error) {
      this.setPlaying(false);
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }
}
