// A job type for Flamenco, written by `steadylight export`. Put it into the folder `scripts` of Flamenco Manager.

const JOB_TYPE = {
    label: "@TITLE@",
    settings: [
        { key: "run_directory", type: "string", subtype: "dir_path", required: true, default: "@RUN_DIRECTORY@",
          description: "The run directory, as all workers see it" },
        { key: "program", type: "string", required: true, default: "@PROGRAM@",
          description: "The steadylight command on the workers" },
        { key: "chunk_size", type: "int32", required: true, default: "@CHUNK@", propargs: { min: 1 },
          description: "Frames that one task renders" },
    ],
};

// Step, key and needs of each task; needs are places in this list.
const PLAN = "@PLAN@";

function compileJob(job) {
    const groups = grouped(Math.max(1, job.settings.chunk_size));
    const groupOf = [];
    groups.forEach((group) => group.places.forEach((place) => { groupOf[place] = group; }));
    const needed = [];
    for (const group of groups) {
        const keys = group.places.map((place) => PLAN[place][1]);
        const name = keys.length > 1 ? `${keys[0]} to ${keys[keys.length - 1]}` : keys[0];
        group.task = task(job, name, keys);
        for (const before of unique(group.needs.map((place) => groupOf[place]))) {
            group.task.addDependency(before.task);
            needed.push(before);
        }
        job.addTask(group.task);
    }
    const last = task(job, "@FINISH@", ["@FINISH@"]);
    for (const group of groups.filter((group) => needed.indexOf(group) < 0)) {
        last.addDependency(group.task);
    }
    job.addTask(last);
}

// Tasks that one command performs: single ones, and frames with the same needs.
function grouped(size) {
    const groups = [];
    PLAN.forEach(([step, key, needs], place) => {
        const last = groups[groups.length - 1];
        const fits = last && ["shade", "aovs"].includes(step) && last.step === step && last.places.length < size
            && last.needs.join() === needs.join();
        if (fits) {
            last.places.push(place);
        } else {
            groups.push({ step: step, needs: needs, places: [place], task: null });
        }
    });
    return groups;
}

function task(job, name, keys) {
    const made = author.Task(name, "misc");
    made.addCommand(author.Command("exec", {
        exe: job.settings.program,
        args: ["perform", job.settings.run_directory].concat(keys),
    }));
    return made;
}

function unique(items) {
    return items.filter((item, place) => items.indexOf(item) === place);
}
