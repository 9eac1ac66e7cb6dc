// The first page: twins, running sessions, recorded episodes.

import { Adder } from "./add";
import { count, el, fixed, place, say } from "./dom";
import type { Page } from "./page";
import type { Pose } from "./pose";
import type { Twin } from "./protocol";
import { Refused, get, useToken } from "./server";
import { isViewers } from "./session";

interface Session {
  session: string;
  twin: string;
  version: number;
  step: number;
  pose: Pose;
  connected: boolean;
}

interface Episode {
  episode: string;
  twin: string;
  version: number;
  steps: number;
  time_us: number;
  modified_us?: number;
  scenario?: string;
  outcome?: string;
  verdict?: string;
}

const REFRESH_MS = 3000;

export class HomePage implements Page {
  readonly element = el("div.home");
  private readonly adder = new Adder(() => void this.load());
  private readonly twins = el("section");
  private readonly sessions = el("section");
  private readonly episodes = el("section");
  private listed = false;
  private timer = 0;
  private ended = false;

  constructor() {
    place();
    this.element.append(this.twins, this.adder.element, this.sessions, this.episodes);
    void this.load();
  }

  end(): void {
    this.ended = true;
    clearTimeout(this.timer);
  }

  private async load(): Promise<void> {
    try {
      const { twins, damaged } = await get<{ twins: Twin[]; damaged?: { name: string; reason: string }[] }>("v1/twins");
      this.showTwins(twins, damaged ?? []);
      await this.loadSessions();
      say("");
    } catch (error) {
      if (error instanceof Refused && error.code === "unauthorized") return this.askToken();
      say(error instanceof Error ? error.message : String(error), "bad");
    }
    if (!this.ended) this.timer = setTimeout(() => void this.load(), REFRESH_MS);
  }

  /** Sessions and episodes are listed for administrators alone. */
  private async loadSessions(): Promise<void> {
    try {
      this.showSessions((await get<{ sessions: Session[] }>("v1/sessions")).sessions);
      // The server reads every record for this list.
      if (this.listed) return;
      this.listed = true;
      this.showEpisodes((await get<{ episodes: Episode[] }>("v1/episodes")).episodes);
    } catch (error) {
      if (!(error instanceof Refused && error.code === "forbidden")) throw error;
    }
  }

  private showTwins(twins: Twin[], damaged: { name: string; reason: string }[]): void {
    const rows = twins.map((twin) => {
      const drives = twin.trajectories.map(({ name, length_m: length }) => `${name} ${fixed(length, 0)} m`).join(", ");
      const name = el("a.name", { href: `#/drive/${twin.name}` }, twin.name);
      return el("tr", {}, el("td", {}, name), el("td.number", {}, `v${twin.version}`),
        el("td.number", {}, count(twin.gaussians)), el("td.drives", {}, drives || "no recorded drive"),
        el("td.actions", {}, el("a.action", { href: `#/drive/${twin.name}` }, "Drive"),
          el("a.action", { href: `#/fly/${twin.name}` }, "Free camera"),
          el("a.action", { href: `#/place/${twin.name}` }, "Place a drive")));
    });
    const broken = damaged.map(({ name, reason }) => el("p.bad", {}, `${name} is damaged: ${reason}`));
    const head = ["twin", "version", "Gaussians", "recorded drives", ""].map((text) => el("th", {}, text));
    const table = rows.length
      ? el("table", {}, el("thead", {}, el("tr", {}, ...head)), el("tbody", {}, ...rows))
      : el("p", {}, "There is no twin on this server. `wildcity import` or `wildcity demo` makes one.");
    this.twins.replaceChildren(el("h2", {}, "Twins"), table, ...broken);
  }

  private showSessions(sessions: Session[]): void {
    const rows = sessions.filter(({ session }) => !isViewers(session)).map(({ session, twin, step, connected }) => el("tr", {},
      el("td", {}, session), el("td", {}, twin), el("td.number", {}, `step ${step}`),
      el("td", {}, connected ? "connected" : "waits to be resumed"),
      el("td.actions", {}, el("a.action", { href: `#/watch/${session}` }, "Watch"))));
    const table = rows.length ? el("table", {}, el("tbody", {}, ...rows)) : el("p.dim", {}, "None at the moment.");
    this.sessions.replaceChildren(el("h2", {}, "Running sessions"), table);
  }

  /** Two episodes can be chosen to be compared. */
  private showEpisodes(episodes: Episode[]): void {
    const drives = episodes.filter(({ episode, steps }) => !isViewers(episode) && steps > 0);
    const compare = el("a.action", { hidden: true }, "Compare");
    const chosen: string[] = [];
    const rows = drives.map((one) => {
      const box = el("input", { type: "checkbox", ariaLabel: `compare ${one.episode}` });
      box.addEventListener("change", () => {
        if (box.checked) chosen.push(one.episode);
        else chosen.splice(chosen.indexOf(one.episode), 1);
        compare.hidden = chosen.length !== 2;
        compare.href = `#/episode/${chosen.join("/")}`;
      });
      const when = one.modified_us ? new Date(one.modified_us / 1000).toLocaleString([], { dateStyle: "short", timeStyle: "short" }) : "";
      const result = [one.scenario, one.verdict ?? one.outcome?.replaceAll("_", " ")].filter(Boolean).join(": ");
      return el("tr", {}, el("td", {}, box), el("td", {}, el("a", { href: `#/episode/${one.episode}` }, one.episode)),
        el("td", {}, one.twin), el("td.number", {}, `${fixed(one.time_us * 1e-6, 1)} s`), el("td.drives", {}, result), el("td.number.dim", {}, when));
    });
    const table = rows.length ? el("table", {}, el("tbody", {}, ...rows)) : el("p.dim", {}, "None yet.");
    this.episodes.replaceChildren(el("h2", {}, "Recorded episodes ", compare), table);
  }

  private askToken(): void {
    const field = el("input", { type: "password", autocomplete: "off", placeholder: "token", ariaLabel: "token" });
    const form = el("form.token", {}, el("p", {}, "This server needs a token. It is kept until this tab is closed."),
      field, el("button", { type: "submit" }, "Continue"));
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      useToken(field.value.trim());
      this.twins.replaceChildren();
      void this.load();
    });
    say("no valid token", "bad");
    this.sessions.replaceChildren();
    this.twins.replaceChildren(form);
    field.focus();
  }
}
