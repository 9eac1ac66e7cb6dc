// The scenarios that play in a twin, with the lanes of their maps.

import type { Vector } from "./pose";
import { get } from "./server";

/** The lanes of each map are rings of x and y. */
export interface TwinScenarios {
  scenarios: { name: string; map?: string }[];
  maps: Record<string, [number, number][][]>;
  omitted_maps: string[];
}

export const scenariosOf = (twin: string): Promise<TwinScenarios> => get<TwinScenarios>(`v1/twins/${twin}/scenarios`);

/** The lanes of some maps at a height. */
export function lanesOf({ maps }: TwinScenarios, names: string[], up: number): Vector[][] {
  return names.flatMap((name) => maps[name] ?? []).map((ring) => ring.map(([east, north]) => [east, north, up]));
}

/** That the server left out the lanes of some maps; empty if it did not. */
export const omittedText = (maps: string[]): string =>
  (maps.length ? `lanes not drawn, too large or not readable: ${maps.join(", ")}` : "");
