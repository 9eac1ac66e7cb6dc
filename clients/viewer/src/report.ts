// The errors of a report on the map: how far each setting of the renderer is from the reference, and where.

import { el, fixed, messageOf, showStatus, showTitle, trustColour } from "./dom";
import { MapView } from "./map";
import type { Page } from "./page";
import { add, clamp, rotate } from "./pose";
import type { Vector } from "./pose";
import type { TwinInfo } from "./messages";
import { parseReport, parseWindows } from "./report-file";
import type { Report, WorstWindow } from "./report-file";
import { Refused, get } from "./server";

/** Errors of this PSNR and less are red, those of the other one and more are blue, in dB. */
const WORST_DB = 20;
const BEST_DB = 60;
const CAPTIONS = ["as rendered", "reference", "error"];

export class ReportPage implements Page {
  readonly element: HTMLElement;
  private readonly map = new MapView();
  private readonly setting = el("select", { ariaLabel: "setting" });
  private readonly places = el("ol.events");
  private readonly window = el("div.windows");
  /** Nothing is there before a report is opened. */
  private readonly beside = el("div.beside", { hidden: true }, this.map.element, this.places);
  private report: Report | undefined;
  private windows = new Map<string, WorstWindow>();
  /** Where each place is; undefined where the server does not have the twin's drive. */
  private positions: (Vector | undefined)[] = [];
  private ended = false;

  constructor() {
    showTitle("report");
    showStatus("");
    const input = el("input", { type: "file", multiple: true, accept: ".json,.html", ariaLabel: "report files" });
    input.addEventListener("change", () => {
      const files = [...(input.files ?? [])];
      input.value = "";
      void this.open(files);
    });
    this.setting.addEventListener("change", () => this.show());
    const chooser = el("div.adder", {}, el("label", {}, "Open report.json and report.html", input), this.setting,
      el("span.dim", {}, "or drop them here: `wildcity report TWIN` writes them"));
    this.setting.hidden = true;
    this.element = el("div.report", {}, chooser, this.window, this.beside);
    this.element.addEventListener("dragover", (event) => event.preventDefault());
    this.element.addEventListener("drop", (event) => {
      event.preventDefault();
      void this.open([...(event.dataTransfer?.files ?? [])]);
    });
  }

  end(): void {
    this.ended = true;
  }

  private async open(files: File[]): Promise<void> {
    try {
      const json = files.find(({ name }) => /\.json$/i.test(name));
      const html = files.find(({ name }) => /\.html$/i.test(name));
      if (!json) throw new Error("choose report.json, and report.html for its pictures");
      const report = parseReport(await json.text());
      this.windows = html ? parseWindows(await html.text()) : new Map();
      this.report = report;
      this.positions = await this.locate(report);
      if (this.ended) return;
      showTitle(el("b", {}, report.twin), ` v${report.version} · report`);
      this.setting.replaceChildren(...report.settings.map(({ name }) => el("option", { value: name }, name)));
      this.setting.hidden = this.beside.hidden = false;
      this.show();
    } catch (error) {
      if (!this.ended) showStatus(messageOf(error), "bad");
    }
  }

  /** The places of a report, along the first recorded drive of the twin. */
  private async locate({ twin, version, places }: Report): Promise<(Vector | undefined)[]> {
    const nowhere = places.map(() => undefined);
    try {
      const { trajectories: [drive] } = await get<TwinInfo>(`v1/twins/${encodeURIComponent(twin)}`);
      if (!drive) return nowhere;
      await this.map.load(twin, version, [drive.name]);
      showStatus("");
      return places.map(({ drive: at }) => {
        const pose = at && this.map.poseAt(drive.name, at.stationM);
        return pose && add(pose.xyz, rotate(pose.q, [0, at.leftM, 0]));
      });
    } catch (error) {
      if (!(error instanceof Refused) || error.code === "unauthorized") throw error;
      showStatus(`no map: ${error.message}`, "bad");
      return nowhere;
    }
  }

  private show(): void {
    const { report } = this;
    const setting = report?.settings.find(({ name }) => name === this.setting.value);
    if (!report || !setting) return;
    const colours = setting.worstDb.map(errorColour);
    this.map.mark(this.positions.flatMap((xyz, at) => (xyz ? [{ xyz, colour: colours[at]! }] : [])));
    this.places.replaceChildren(...report.places.map(({ name }, at) => {
      const dot = el("i.dot");
      dot.style.background = colours[at]!;
      return el("li", {}, dot, `${name}: ${decibels(setting.worstDb[at]!)}`);
    }));
    void this.showWindow(this.windows.get(setting.name));
  }

  private async showWindow(window: WorstWindow | undefined): Promise<void> {
    const text = window ? `The worst window is at ${window.place}.` : "Open report.html as well to see the worst window.";
    const pictures = await Promise.all((window?.files ?? []).map((file) => createImageBitmap(file)));
    const figures = pictures.map((picture, at) => {
      const { width, height } = picture;
      const canvas = el("canvas", { width, height });
      canvas.getContext("2d")!.drawImage(picture, 0, 0);
      picture.close();
      return el("figure", {}, canvas, el("figcaption", {}, CAPTIONS[at] ?? ""));
    });
    this.window.replaceChildren(el("p.dim", {}, text), ...figures);
  }
}

const decibels = (db: number): string => (db === Infinity ? "exact" : `${fixed(db, 1)} dB`);

/** The colours are those of the trust. */
const errorColour = (db: number): string => trustColour(clamp((db - WORST_DB) / (BEST_DB - WORST_DB), 0, 1));
