import { drawCurves, element, embedded } from "./common.js";

if (element("curve")) drawCurves(element("curve"), embedded("curves"));
