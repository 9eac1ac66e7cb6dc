// Watch a running session: its newest observations, without taking part in it.

import { el, messageOf, showStatus, showTitle } from "./dom";
import { Facts, forwardSpeed } from "./facts";
import { MapView } from "./map";
import { Mosaic } from "./mosaic";
import type { Page } from "./page";
import { StagePlot } from "./plot";
import { PointsView } from "./points";
import { WATCH_PROTOCOL, parseObservation } from "./protocol";
import type { Metadata, TwinInfo } from "./messages";
import type { Observation } from "./protocol";
import { get, socket } from "./server";

export class WatchPage implements Page {
  readonly element: HTMLElement;
  private readonly mosaic = new Mosaic();
  private readonly map = new MapView();
  private readonly plot = new StagePlot();
  private readonly points = new PointsView();
  private readonly facts = new Facts();
  private readonly session: string;
  private socket: WebSocket | undefined;
  private loaded = "";
  private newest: Observation | undefined;
  private draws = false;
  private ended = false;

  constructor(session: string) {
    this.session = session;
    const note = el("p.keys", {}, "At most ten images a second of each camera, as the agent gets them. The session does not wait for you.");
    this.element = el("div.view", {},
      el("div.left", {}, this.mosaic.element),
      el("aside.right", {}, this.map.element, this.points.element, this.facts.element, this.plot.element, note));
    showTitle(el("b", {}, session), " · watch");
    void this.begin();
  }

  end(): void {
    this.ended = true;
    this.socket?.close(1000);
  }

  private async begin(): Promise<void> {
    try {
      this.socket = await socket(`v1/sessions/${encodeURIComponent(this.session)}/watch`, WATCH_PROTOCOL);
    } catch {
      if (this.ended) return;
      return showStatus(`${this.session} cannot be watched: it has ended, or belongs to another token`, "bad");
    }
    if (this.ended) return this.socket.close(1000);
    showStatus("waiting for the next step");
    this.socket.onmessage = ({ data }) => {
      this.newest = parseObservation(data as ArrayBuffer);
      void this.draw();
    };
    this.socket.onclose = ({ code }) => {
      if (!this.ended) showStatus(code === 1000 ? "the session ended" : "the connection is lost", code === 1000 ? "" : "bad");
    };
  }

  /** Draws the newest observation; those that came while another was drawn are left out. */
  private async draw(): Promise<void> {
    if (this.draws) return;
    this.draws = true;
    try {
      while (this.newest && !this.ended) {
        const observation = this.newest;
        this.newest = undefined;
        const { metadata } = observation;
        await this.load(metadata);
        this.map.show(metadata);
        this.points.show(observation);
        this.plot.show(metadata);
        this.facts.show(metadata);
        this.element.dataset.step = String(metadata.step);
        this.mosaic.drives(metadata.time_us, forwardSpeed(metadata));
        await this.mosaic.show(observation);
        showStatus(`${metadata.twin} v${metadata.version}, ${metadata.backend}`, "good");
      }
    } catch (error) {
      showStatus(messageOf(error), "bad");
    } finally {
      this.draws = false;
    }
  }

  private async load({ twin, version }: Metadata): Promise<void> {
    const key = `${twin}@${version}`;
    if (this.loaded === key) return;
    this.loaded = key;
    const { trajectories } = await get<TwinInfo>(`v1/twins/${twin}`);
    await this.map.load(twin, version, trajectories.map(({ name }) => name));
  }
}
