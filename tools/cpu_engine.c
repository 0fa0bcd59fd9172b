/* Physics steps of many robots on the cores of a CPU, for cpu_engine.py.

   Every thread has one mjModel and one mjData, which stay in its cache. States come in and go out
   in single precision, as MuJoCo Warp holds them; what differs from robot to robot in the model is
   copied in before each step. */

#include <math.h>
#include <mujoco/mujoco.h>
#include <omp.h>
#include <stdlib.h>
#include <string.h>

/* Fields of the model that robots have of their own, in the order of FIELDS in cpu_engine.py. */
enum { NFIELD = 12 };

typedef struct {
  mjModel *model;
  mjData *data;
  mjtNum *field[NFIELD];
} Worker;

typedef struct {
  int threads;
  Worker *worker;
  int size[NFIELD];            /* numbers a robot; 0: not given */
  const mjtNum *value[NFIELD]; /* (robots, size) */
} Engine;

/* Arrays of mujoco_warp.Data, (robots, ...), in the order of STATE and DERIVED in cpu_engine.py. */
typedef struct {
  float *qpos, *qvel, *ctrl, *qfrc_applied, *qacc_warmstart;
  float *xpos, *xquat, *xmat, *site_xpos, *subtree_com, *cvel;
  float *qfrc_actuator, *actuator_force, *sensordata, *qacc;
} Arrays;

Engine *engine_new(const mjModel *model, int threads) {
  Engine *engine = calloc(1, sizeof *engine);
  engine->threads = threads;
  engine->worker = calloc(threads, sizeof *engine->worker);
  for (int t = 0; t < threads; t++) {
    mjModel *m = mj_copyModel(NULL, model);
    /* A state that is not finite is the environment's to see, not the engine's to hide. */
    m->opt.disableflags |= mjDSBL_AUTORESET;
    Worker w = {m,
                mj_makeData(m),
                {m->geom_friction, m->geom_pos, m->geom_size, m->geom_rbound, m->geom_aabb,
                 m->site_pos, m->body_mass, m->body_inertia, m->body_subtreemass,
                 m->body_invweight0, m->dof_invweight0, m->dof_M0}};
    engine->worker[t] = w;
  }
  return engine;
}

void engine_free(Engine *engine) {
  for (int t = 0; t < engine->threads; t++) {
    mj_deleteData(engine->worker[t].data);
    mj_deleteModel(engine->worker[t].model);
  }
  free(engine->worker);
  free(engine);
}

/* The caller keeps `value` alive. */
void engine_field(Engine *engine, int field, int size, const mjtNum *value) {
  engine->size[field] = size;
  engine->value[field] = value;
}

static int read_state(mjtNum *to, const float *from, int n) {
  int finite = 1;
  for (int i = 0; i < n; i++) {
    to[i] = from[i];
    finite &= isfinite(from[i]);
  }
  return finite;
}

static void write_state(float *to, const mjtNum *from, int n) {
  for (int i = 0; i < n; i++) to[i] = (float)from[i];
}

/* One mj_step (step) or mj_forward of every robot; one whose state is not finite stays as it is. */
void engine_advance(const Engine *engine, int robots, int step, const Arrays *arrays) {
  const Arrays a = *arrays;
#pragma omp parallel for num_threads(engine->threads) schedule(dynamic, 16)
  for (int r = 0; r < robots; r++) {
    const Worker *w = &engine->worker[omp_get_thread_num()];
    const mjModel *m = w->model;
    mjData *d = w->data;
    const int nq = m->nq, nv = m->nv, nu = m->nu, nb = m->nbody, ns = m->nsite, n = m->nsensordata;
    for (int f = 0; f < NFIELD; f++) {
      const size_t size = engine->size[f];
      if (size) memcpy(w->field[f], engine->value[f] + r * size, size * sizeof(mjtNum));
    }
    int finite = read_state(d->qpos, a.qpos + r * nq, nq);
    finite &= read_state(d->qvel, a.qvel + r * nv, nv);
    finite &= read_state(d->ctrl, a.ctrl + r * nu, nu);
    finite &= read_state(d->qfrc_applied, a.qfrc_applied + r * nv, nv);
    finite &= read_state(d->qacc_warmstart, a.qacc_warmstart + r * nv, nv);
    if (!finite) continue;
    if (step) {
      mj_step(m, d);
      write_state(a.qpos + r * nq, d->qpos, nq);
      write_state(a.qvel + r * nv, d->qvel, nv);
    } else {
      mj_forward(m, d);
    }
    write_state(a.qacc_warmstart + r * nv, d->qacc_warmstart, nv);
    write_state(a.xpos + r * nb * 3, d->xpos, nb * 3);
    write_state(a.xquat + r * nb * 4, d->xquat, nb * 4);
    write_state(a.xmat + r * nb * 9, d->xmat, nb * 9);
    write_state(a.site_xpos + r * ns * 3, d->site_xpos, ns * 3);
    write_state(a.subtree_com + r * nb * 3, d->subtree_com, nb * 3);
    write_state(a.cvel + r * nb * 6, d->cvel, nb * 6);
    write_state(a.qfrc_actuator + r * nv, d->qfrc_actuator, nv);
    write_state(a.actuator_force + r * nu, d->actuator_force, nu);
    write_state(a.sensordata + r * n, d->sensordata, n);
    write_state(a.qacc + r * nv, d->qacc, nv);
  }
}
